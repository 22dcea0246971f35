"""Plots of the errors that the table summarizes."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from cfr_jax.data.pairs import Pair
from cfr_jax.evaluation import metrics
from cfr_jax.evaluation.measuring import Measured
from cfr_jax.runtime.atomic import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_BINS = 5  # bins of pairs sorted by overlap or rotation, with equally many pairs each
_DPI = 150
_NO_METHODS = ("identity", "truth")  # bounds, which would only stretch the axes


def new_figure(width: float, height: float) -> Figure:
    """A figure that needs no display.

    Raises a ModuleNotFoundError that says what to do if matplotlib is missing.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            'plots need matplotlib: pip install "cfr_jax[viz]", or --plots=false', name="matplotlib"
        ) from error
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Writes a figure as PNG; the same figure gives the same file."""
    png = io.BytesIO()
    figure.savefig(png, format="png", dpi=_DPI, metadata={"Software": None})
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, png.getvalue())


def draw_all(
    folder: Path, measured: Sequence[Measured], pairs: Sequence[Pair], about: dict[str, Any]
) -> None:
    """Writes the plots into `folder`."""
    unit = about["unit"] or "units"
    angle, distance = about["limits"]
    shown = [m for m in measured if m.answered.any() and m.about["use"] not in _NO_METHODS]
    if not shown:
        return
    recall_over_error(folder / "recall.png", shown, angle, distance, unit)
    turned = metrics.err_r(
        np.tile(np.eye(4), (len(pairs), 1, 1)), np.array([pair.transform for pair in pairs])
    )
    by_quantity(folder / "by_rotation.png", shown, turned, "true rotation (degrees)", about)
    if all(pair.overlap is not None for pair in pairs):
        overlap = np.array([pair.overlap for pair in pairs], np.float64)
        by_quantity(folder / "by_overlap.png", shown, overlap, "overlap", about)
    by_iteration(folder / "by_iteration.png", shown, unit)
    time_against_accuracy(folder / "time.png", shown, about)
    time_by_module(folder / "modules.png", [m for m in shown if m.modules])


def recall_over_error(
    path: Path, measured: Sequence[Measured], angle: float, distance: float, unit: str
) -> None:
    """Share of all pairs whose error is below a bound, plotted over the bound."""
    figure = new_figure(11, 4.2)
    panels = ("err_r", angle), ("err_t", distance)
    for axes, (name, most) in zip(figure.subplots(1, 2), panels, strict=True):
        bounds, label = np.linspace(0, most, 200), metrics.named(name).axis_label(unit)
        for style, m in _styled(measured):
            errors = np.sort(np.nan_to_num(m.errors[name][:, -1], nan=np.inf))
            axes.plot(bounds, np.searchsorted(errors, bounds) / len(errors), **style)
        axes.set(xlabel=label, ylabel="share of pairs", ylim=(0, 1), xlim=(0, bounds[-1]))
    _finish(figure, path)


def by_quantity(
    path: Path,
    measured: Sequence[Measured],
    quantity: Float[np.ndarray, " p"],
    label: str,
    about: dict[str, Any],
) -> None:
    """Median rotation error and recall, in bins of equally many pairs sorted by `quantity`."""
    bins = np.array_split(np.argsort(quantity, kind="stable"), min(_BINS, len(quantity)))
    centers = [quantity[rows].mean() for rows in bins]
    threshold = tuple(about["main_threshold"])
    figure = new_figure(11, 4.2)
    left, right = figure.subplots(1, 2)
    for style, m in _styled(measured):
        left.plot(centers, [_median(m.err_r[rows, -1]) for rows in bins], marker="o", **style)
        hits = m.recalled(*threshold)
        right.plot(centers, [hits[rows].mean() for rows in bins], marker="o", **style)
    left.set(xlabel=label, ylabel="median rotation error (degrees)")
    _logarithmic(left.set_yscale, measured)
    right.set(xlabel=label, ylabel=_recall_label(about), ylim=(-0.02, 1.02))
    _finish(figure, path)


def by_iteration(path: Path, measured: Sequence[Measured], unit: str) -> None:
    """Mean and median error after each iteration, for methods that report more than one.

    A refinement counts as one more iteration.
    """
    if all(m.err_r.shape[1] == 1 for m in measured):
        return
    shown = [metric for metric in metrics.entries() if metric.each_iteration]
    figure = new_figure(1.0 + 5 * len(shown), 4.2)
    for axes, metric in zip(figure.subplots(1, len(shown)), shown, strict=True):
        label = metric.axis_label(unit)
        for style, m in _styled(measured):
            errors = m.errors[metric.name][m.answered]
            if errors.shape[1] == 1:
                continue
            steps = np.arange(1, errors.shape[1] + 1)
            axes.plot(steps, errors.mean(axis=0), marker="o", **style)
            axes.plot(steps, np.median(errors, axis=0), ls=":", color=style["color"])
        axes.set(xlabel="iteration", ylabel=f"{label}: mean, median dotted", ylim=(0, None))
        axes.xaxis.get_major_locator().set_params(integer=True)
    _finish(figure, path)


def time_against_accuracy(path: Path, measured: Sequence[Measured], about: dict[str, Any]) -> None:
    """One point per method: how long it takes, and how good it is."""
    from matplotlib.ticker import LogLocator, NullFormatter

    figure = new_figure(11, 4.2)
    left, right = figure.subplots(1, 2)
    for style, m in _styled(measured):
        time = m.milliseconds()
        for axes, value in (
            (left, np.nanmean(m.err_r[:, -1])),
            (right, m.recalled(*about["main_threshold"]).mean()),
        ):
            axes.plot([time], [value], marker="o", ms=9, **style | {"ls": ""})
    for axes in (left, right):
        axes.set(xscale="log", xlabel="ms per pair")
        # the axis covers less than two decades: powers of ten alone would be too few ticks
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
    left.set(ylabel="mean rotation error (degrees)")
    right.set(ylabel=_recall_label(about), ylim=(-0.02, 1.02))
    _finish(figure, path)


def time_by_module(path: Path, measured: Sequence[Measured]) -> None:
    """A group of bars for each module, with one bar for each method whose modules were timed."""
    if not measured:
        return
    parts = list(dict.fromkeys(part for m in measured for part in m.modules or {}))
    figure = new_figure(11, 4.2)
    axes = figure.subplots()
    width = 0.8 / len(measured)
    for place, (style, m) in enumerate(_styled(measured)):
        times = [(m.modules or {}).get(part, 0) * 1e3 for part in parts]
        across = np.arange(len(parts)) + (place - (len(measured) - 1) / 2) * width
        bars = axes.bar(across, times, width, color=style["color"], label=m.name)
        axes.bar_label(
            bars, [f"{time:.3g}" if time < 100 else f"{time:.0f}" for time in times], fontsize=7
        )
    axes.set_xticks(range(len(parts)), parts)
    axes.set(yscale="log", ylabel="ms per pair")
    _finish(figure, path)


def _styled(measured: Sequence[Measured]) -> list[tuple[dict[str, Any], Measured]]:
    """The style of each method: ours solid and bold, the others dashed, each in its own color."""
    from matplotlib import colormaps

    colors = colormaps["tab20"]
    styled = []
    for number, m in enumerate(measured):
        own = m.about["use"] == "cfr"
        style = {"label": m.name, "color": colors(number % colors.N)}
        styled.append((style | {"ls": "-" if own else "--", "lw": 2.2 if own else 1.3}, m))
    return styled


def _median(values: Float[np.ndarray, " k"]) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.nan


def _logarithmic(set_scale: Callable[..., None], measured: Sequence[Measured]) -> None:
    if any((m.err_r[m.answered, -1] > 0).any() for m in measured):
        set_scale("log")


def _recall_label(about: dict[str, Any]) -> str:
    angle, distance = about["main_threshold"]
    return f"recall ({angle:g}°, {distance:g}{' ' + about['unit'] if about['unit'] else ''})"


def _finish(figure: Figure, path: Path) -> None:
    handles: dict[str, Any] = {}
    for axes in figure.axes:
        axes.grid(alpha=0.3)
        handles |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    figure.legend(handles.values(), handles.keys(), loc="outside right center", fontsize=8)
    save_figure(figure, path)
