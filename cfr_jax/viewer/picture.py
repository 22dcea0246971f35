"""The registration as a PNG with before and after side by side, for papers and reports."""

import io
import os
import textwrap
import warnings
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from cfr_jax.runtime.atomic import write_atomically
from cfr_jax.viewer.camera import best_view
from cfr_jax.viewer.scene import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SOURCE = np.array([1.0, 0.706, 0.0])  # these colors are familiar from Open3D
TARGET = np.array([0.0, 0.651, 0.929])
INK, WARN = "#1b2029", "#8a5a00"
HAZE = 0.45  # how much the points at the back fade into the white background

# Inches.
WIDTH, MARGIN, TOP, LINE, DPI = 10.0, 0.15, 1.0, 0.26, 160
FLATTEST, TALLEST = 0.45, 1.1  # limits for the height of a panel divided by its width

MOST_POINTS = 20_000  # per cloud; a panel has no room for more

# If the start is this many times wider than the answer, the answer would be a dot at the same
# scale. Each panel then has its own scale, and the title says so.
WIDEST = 2.5


def write_picture(path: str | os.PathLike[str], scene: Scene) -> None:
    """Writes a PNG of `scene`, before and after side by side, to `path`; needs no display.

    Both panels look along the direction of least spread of the aligned clouds, tilted a little.
    They have the same scale, unless the source starts very far away; then the title says so. With
    one version of matplotlib, the same scene always gives the same file.

    Raises ModuleNotFoundError if matplotlib (the `viz` extra) is missing, and OSError if `path`
    cannot be written.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            'pictures need matplotlib: pip install "cfr_jax[viz]"', name="matplotlib"
        ) from error

    view = best_view(scene)
    target = (_some(scene.target) - view.center) @ view.rotation.T
    sources = [(_some(scene.moved(k)) - view.center) @ view.rotation.T for k in (0, -1)]
    centers, halves, zoom = _frames([(source, target) for source in sources])
    width = WIDTH / 2 - 1.5 * MARGIN
    height = width * halves[-1][1] / halves[-1][0]

    lines = _lines(scene)
    below = LINE * (len(lines) + 1)
    total = TOP + height + below
    figure = Figure(figsize=(WIDTH, total), facecolor="white")
    FigureCanvasAgg(figure)
    titles = ("before" if zoom is None else f"before (seen {zoom:.0f}× wider)", "after")
    for column, (title, source) in enumerate(zip(titles, sources, strict=True)):
        left = MARGIN + column * (width + MARGIN)
        axes = figure.add_axes((left / WIDTH, below / total, width / WIDTH, height / total))
        _draw_clouds(axes, source, target, depth=view.radii[-1])
        (x, y), (dx, dy) = centers[column], halves[column]
        axes.set(xlim=(x - dx, x + dx), ylim=(y - dy, y + dy))
        axes.set_title(title, color=INK, fontsize=13, fontweight="bold", pad=8)
    _write_legend(figure, scene, y=1 - 0.32 / total)
    for row, (text, color) in enumerate(lines):
        height_of_line = (below - LINE * (row + 1)) / total
        figure.text(
            0.5, height_of_line, text, ha="center", color=color, fontsize=10.5, parse_math=False
        )

    png = io.BytesIO()
    with warnings.catch_warnings():
        # Letters that matplotlib's font lacks are drawn as boxes, without a warning.
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        figure.savefig(png, format="png", dpi=DPI, metadata={"Software": None})
    write_atomically(path, png.getvalue())


def _some(points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "k 3"]:
    if len(points) <= MOST_POINTS:
        return points
    return points[np.random.default_rng(0).permutation(len(points))[:MOST_POINTS]]


def _frames(
    panels: list[tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "m 3"]]],
) -> tuple[list[np.ndarray], list[np.ndarray], float | None]:
    """Center and half size of each panel, and how many times wider the first one's view is (None:
    equal)."""
    # Quantiles, so that a stray point does not shrink the rest. A margin is added below.
    ends = np.array(
        [[np.quantile(cloud[:, :2], [0.01, 0.99], axis=0) for cloud in clouds] for clouds in panels]
    )  # panel, cloud, low or high, axis
    boxes = np.stack([ends[:, :, 0].min(axis=1), ends[:, :, 1].max(axis=1)], axis=1)
    together = np.array([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])
    zoom = np.ptp(together, axis=0).max() / max(np.ptp(boxes[-1], axis=0).max(), 1e-300)
    shown = [together, boxes[-1]] if zoom > WIDEST else [together, together]
    halves = [np.maximum(np.ptp(box, axis=0) * 0.6, 1e-9) for box in shown]
    shape = float(np.clip(halves[-1][1] / halves[-1][0], FLATTEST, TALLEST))
    halves = [max(dx, dy / shape) * np.array([1.0, shape]) for dx, dy in halves]
    return [box.mean(axis=0) for box in shown], halves, zoom if zoom > WIDEST else None


def _draw_clouds(
    axes: "Axes",
    source: Float64[np.ndarray, "n 3"],
    target: Float64[np.ndarray, "m 3"],
    depth: float,
) -> None:
    """Draws both clouds in one scatter from back to front, so that neither is always on top."""
    points = np.concatenate([source, target])
    colors = np.repeat([SOURCE, TARGET], [len(source), len(target)], axis=0)
    haze = HAZE * np.clip(0.5 - points[:, 2:] / (2 * depth), 0.0, 1.0)
    colors = colors * (1 - haze) + haze
    order = np.argsort(points[:, 2], kind="stable")
    diameter = min(7.0, 45.0 * len(points) ** -0.32)  # typographic points
    axes.scatter(
        points[order, 0],
        points[order, 1],
        s=diameter**2,
        c=colors[order],
        # A thin rim separates neighbors. Matplotlib accepts an (n, 3) array, its stubs do not.
        edgecolors=0.72 * colors[order],  # type: ignore[arg-type]
        linewidths=0.08 * diameter,
    )
    axes.set_axis_off()


def _write_legend(figure: "Figure", scene: Scene, y: float) -> None:
    from matplotlib.lines import Line2D

    handles = []
    for role, name, count, color in (
        ("source", scene.source_name, len(scene.source), SOURCE),
        ("target", scene.target_name, len(scene.target), TARGET),
    ):
        shown = role if name == role else f"{role}: {_shortened(_printable(name))}"
        label = f"{shown} ({count:,} points)"
        red, green, blue = color
        handles.append(
            Line2D([], [], ls="", marker="o", ms=9, color=(red, green, blue), label=label)
        )
    legend = figure.legend(
        handles=handles,
        loc="center",
        bbox_to_anchor=(0.5, y),
        ncols=2,
        frameon=False,
        fontsize=11,
        labelcolor=INK,
        handletextpad=0.2,
    )
    for text in legend.get_texts():
        text.set_parse_math(False)  # a $ in a file name is a $


def _lines(scene: Scene) -> list[tuple[str, str]]:
    """Facts, then warnings, wrapped to the width of the picture, with their colors."""
    # Non-breaking spaces keep each fact on one line.
    facts = [f"{name}\u00a0 {text}".replace(" ", "\u00a0") for name, text in scene.facts.items()]
    texts = [("     ".join(facts), INK)] + [(text, WARN) for text in scene.warnings]
    return [
        (_printable(line), color)
        for text, color in texts
        for line in textwrap.wrap(text, width=124)
    ]


def _printable(text: str) -> str:
    """The text with control characters and undecodable bytes replaced, which no font can draw."""
    return "".join(
        c if c.isprintable() or c == "\u00a0" else "\N{REPLACEMENT CHARACTER}" for c in text
    )


def _shortened(text: str, most: int = 30) -> str:
    return text if len(text) <= most else f"{text[: most // 2]}…{text[-most // 2 + 1 :]}"
