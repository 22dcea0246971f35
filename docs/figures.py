"""Draws the figures of the documentation into docs/images, from the pair that ships.

python docs/figures.py
"""

from __future__ import annotations

import json
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

import cfr_jax
from cfr_jax import io
from cfr_jax.alignment import align as alignment
from cfr_jax.cli.shared.cache import keep_compiled_programs
from cfr_jax.evaluation import metrics
from cfr_jax.geometry import motions
from cfr_jax.networks.cfr import iterations, registration

IMAGES = Path(__file__).parent / "images"
DEMO = Path(cfr_jax.__file__).parent / "cli" / "demo_pair"
SOURCE, TARGET = (1.0, 0.706, 0.0), (0.0, 0.651, 0.929)  # as the viewer colors them
INK, QUIET, PAPER = "#1b2029", "#5a6472", "#f3f5f8"
LOUD, CALM = "#ffe9b8", "#d9eefb"


def main() -> None:
    keep_compiled_programs()
    draw_cascade(IMAGES / "cascade.png")
    source, target = (io.read(DEMO / f"{role}.ply") for role in ("source", "target"))
    truth = np.asarray(json.loads((DEMO / "truth.json").read_text("utf-8"))["transform"])
    found = alignment.align(source, target)
    draw_iterations(IMAGES / "iterations.png", source, target, found, truth)
    draw_match(IMAGES / "sinkhorn.png", *unit_pair(source, target, found))


def save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=110, metadata={"Software": None})
    print(f"wrote {path}")


def draw_cascade(path: Path) -> None:
    """What is computed once and what in each iteration."""
    figure = Figure(figsize=(10.2, 4.9), facecolor="white")
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, 102), ylim=(0, 49))
    axes.set_axis_off()

    def box(x, y, width, text, color=PAPER, height=6.4):
        shape = FancyBboxPatch(
            (x, y), width, height, "round,pad=0,rounding_size=1", fc=color, ec=QUIET, lw=0.8
        )
        axes.add_patch(shape)
        style = {"ha": "center", "va": "center", "fontsize": 9, "color": INK, "linespacing": 1.35}
        axes.text(x + width / 2, y + height / 2, text, **style)

    def arrow(start, end, bend=0.0, color=QUIET):
        style = {"arrowstyle": "-|>", "mutation_scale": 10, "lw": 1.0, "color": color}
        axes.add_patch(
            FancyArrowPatch(start, end, connectionstyle=f"arc3,rad={bend}", shrinkA=0, **style)
        )

    def note(x, y, text):
        axes.text(x, y, text, ha="left", va="center", fontsize=9, color=QUIET)

    rows = {"source": 37.0, "target": 7.5}
    note(1, 46.8, "once per cloud")
    note(47, 46.8, "in each iteration, own weights")
    for (role, y), color in zip(rows.items(), (SOURCE, TARGET), strict=True):
        axes.add_patch(
            FancyBboxPatch(
                (1, y), 9, 6.4, "round,pad=0,rounding_size=1", fc=color, ec="none", alpha=0.55
            )
        )
        style = {"ha": "center", "va": "center", "fontsize": 10, "color": INK}
        axes.text(5.5, y + 3.2, role, fontweight="bold", **style)
        box(12, y, 13, "64 neighbors,\n7 raw channels")
        box(27, y, 17, "heavy extraction:\nMLP, then maximum", LOUD)
        box(48, y, 17, "light layer i:\nfeatures + B position", CALM)
        for x in (10, 25, 44):
            arrow((x, y + 3.2), (x + (4 if x == 44 else 2), y + 3.2))
    box(27, 21, 17, "annealing net:\nall α, β at once", LOUD)
    arrow((5.5, 37), (27, 24.8), bend=0.15)
    arrow((5.5, 13.9), (27, 23.6), bend=-0.15)
    box(69, 21, 15, "match: Sinkhorn\nwith slack,\ni passes", CALM, height=7.4)
    arrow((44, 24.4), (69, 24.7))
    arrow((65, 39.2), (75, 28.4), bend=-0.2)
    arrow((65, 11.7), (75, 21), bend=0.2)
    box(87, 21, 13, "rigid motion:\nweighted\nProcrustes", CALM, height=7.4)
    arrow((84, 24.7), (87, 24.7))
    arrow((93.5, 28.4), (60, 43.4), bend=0.42, color="#0073a8")
    says = {"fontsize": 8.5, "color": "#0073a8"}
    for y, text in (
        (43.6, "moves the source's positions;"),
        (41.5, "its features are never redone"),
    ):
        axes.text(101, y, text, ha="right", **says)
    for y, text in ((37, "cascade"), (7.5, "cascade; all layers at once, as the target rests")):
        arrow((51, y), (62, y), bend=0.75, color="#0073a8")
        axes.text(56.5, y - 6.2, text, ha="center", **says)
    save(figure, path)


def draw_iterations(path: Path, source, target, found, truth) -> None:
    """The source at every station of the motion, and how far it is from the truth."""
    start = np.eye(4)  # where `align` begins: one centroid on the other
    start[:3, 3] = target.points.mean(axis=0) - source.points.mean(axis=0)
    stations = [("start", start)]
    last = len(found.transforms) - 1
    shown = [*range(len(found.transforms) // 2), last]  # of the second cascade only where it ended
    stations += [(f"iteration {i + 1}", found.transforms[i]) for i in shown]
    stations.append(("refined" if found.refined else "answer", found.transform))
    figure = Figure(figsize=(10.2, 2.0), facecolor="white")
    middle = target.points.mean(axis=0)
    _, _, axes_of = np.linalg.svd(target.points - middle, full_matrices=False)
    flat = (target.points - middle) @ axes_of[:2].T
    for column, (label, transform) in enumerate(stations):
        axes = figure.add_axes((column / len(stations), 0.24, 1 / len(stations), 0.72))
        moved = motions.apply(transform, source.points)
        moved = (moved - middle) @ axes_of[:2].T
        both = np.concatenate([flat, moved])
        colors = np.repeat([TARGET, SOURCE], [len(flat), len(moved)], axis=0)
        order = np.random.default_rng(0).permutation(len(both))  # neither hides the other
        axes.scatter(*both[order].T, s=0.7, c=colors[order], linewidths=0)
        reach = 1.1 * np.abs(flat).max()
        axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
        axes.set_axis_off()
        error = float(metrics.err_r(transform[None], truth[None])[0])
        x = (column + 0.5) / len(stations)
        figure.text(x, 0.17, label, ha="center", fontsize=10, color=INK)
        figure.text(x, 0.05, f"{error:.1f}° off", ha="center", fontsize=9.5, color=QUIET)
    save(figure, path)


def unit_pair(source, target, found):
    """The two clouds about as the network saw them, and what it finds between them."""
    points = [source.points[found.source_rows], target.points[found.target_rows]]
    points = [part - part.mean(axis=0) for part in points]
    scale = max(np.linalg.norm(part, axis=1).max() for part in points)
    settings = registration.Settings()

    @jax.jit
    def steps(params, source, target):
        clouds = [registration.prepare(part, settings=settings) for part in (source, target)]
        return [
            (step.transform, step.affinity.log())
            for step in iterations.unroll(params, *clouds, settings)
        ]

    unit = [np.asarray(part / scale, np.float32) for part in points]
    found = steps(cfr_jax.load_params(), *unit)
    return unit, [(np.asarray(transform), np.asarray(log)) for transform, log in found]


def draw_match(path: Path, unit, steps) -> None:
    """The normalized affinities after iterations 1, 3 and 5, both clouds in one order."""
    last = steps[-1][0]
    moved = motions.apply(last, unit[0])
    _, _, axes_of = np.linalg.svd(unit[1] - unit[1].mean(axis=0), full_matrices=False)
    rows, columns = (np.argsort(part @ axes_of[0]) for part in (moved, unit[1]))
    shown = (0, 2, 4)
    figure = Figure(figsize=(10.2, 4.1), facecolor="white")
    for panel, i in enumerate(shown):
        block = normalized(steps[i][1], passes=i + 1)
        axes = figure.add_axes((0.055 + 0.32 * panel, 0.16, 0.245, 0.7))
        image = np.sqrt(np.maximum(coarse(block[rows][:, columns]), 0))
        axes.imshow(image, cmap="magma", vmin=0, vmax=np.quantile(image, 0.995), aspect="auto")
        axes.set(xticks=[], yticks=[])
        axes.set_title(f"iteration {i + 1}: {i + 1} pass{'es' if i else ''}", fontsize=10.5)
        axes.set_xlabel("target points, along the object", fontsize=9, color=QUIET)
        if panel == 0:
            axes.set_ylabel("source points, along the object", fontsize=9, color=QUIET)
        weights = block[rows].sum(axis=1)
        side = figure.add_axes((0.303 + 0.32 * panel, 0.16, 0.035, 0.7))
        side.fill_betweenx(np.arange(len(weights)), weights, color="#e44686", lw=0)
        side.set(xlim=(0, 1), ylim=(len(weights), 0), xticks=[0, 1], yticks=[])
        side.tick_params(labelsize=7, colors=QUIET)
        side.set_title("weight", fontsize=8, color=QUIET)
    save(figure, path)


def normalized(log_affinity: np.ndarray, passes: int) -> np.ndarray:
    """The affinities after so many passes, with slack, in float64."""
    padded = np.pad(np.exp(log_affinity.astype(float)), ((0, 1), (0, 1)), constant_values=1.0)
    for _ in range(passes):
        padded[:-1] /= padded[:-1].sum(axis=1, keepdims=True)
        padded[:, :-1] /= padded[:, :-1].sum(axis=0, keepdims=True)
    return padded[:-1, :-1]


def coarse(block: np.ndarray, size: int = 180) -> np.ndarray:
    """Mean over patches, so that a picture of that many cells shows it all."""
    edges = [np.linspace(0, length, size + 1).astype(int) for length in block.shape]
    sums = block.cumsum(axis=0).cumsum(axis=1)
    sums = np.pad(sums, ((1, 0), (1, 0)))[np.ix_(*edges)]
    return np.diff(np.diff(sums, axis=0), axis=1)


if __name__ == "__main__":
    main()
