"""A contact sheet: some shapes of each category in one picture."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from cfr_jax.data.corpus import Corpus
from cfr_jax.data.making.shapes import name_share
from cfr_jax.runtime.atomic import write_atomically

_INCH = 1.15  # inches per shape
_LABEL = 1.8  # inches for the category's name
_DPI = 100
_TURN = np.radians(35.0)  # about the vertical axis, then tilted: most shapes are upright with y up
_TILT = np.radians(20.0)


def write_sheet(path: Path, corpus: Corpus, columns: int = 8) -> None:
    """Writes a PNG with up to `columns` shapes of each category, colored by their normals.

    Raises ModuleNotFoundError if matplotlib (the `viz` extra) is missing.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            'pictures need matplotlib: pip install "cfr_jax[viz]"', name="matplotlib"
        ) from error

    present = [label for label in range(len(corpus.categories)) if (corpus.labels == label).any()]
    width, height = _LABEL + columns * _INCH, len(present) * _INCH
    figure = Figure(figsize=(width, height), facecolor="white")
    FigureCanvasAgg(figure)
    view = _view()
    for line, label in enumerate(present):
        rows = np.flatnonzero(corpus.labels == label).tolist()
        bottom = 1 - (line + 1) * _INCH / height
        title = f"{corpus.categories[label]}\n{len(rows)}"
        figure.text(0.1 / width, bottom + 0.5 * _INCH / height, title, fontsize=9, va="center")
        shown = sorted(rows, key=lambda row: name_share(corpus.names[row], "sheet"))[:columns]
        for column, row in enumerate(shown):
            left = (_LABEL + column * _INCH) / width
            axes = figure.add_axes((left, bottom, _INCH / width, _INCH / height))
            points, normals = corpus[row]
            points = points @ view.T
            order = np.argsort(points[:, 2])
            colors = 0.15 + 0.8 * np.abs(normals @ view.T)[order]
            x, y, _ = points[order].T
            axes.scatter(x, y, s=0.6, c=colors, linewidths=0)
            axes.set(xlim=(-1, 1), ylim=(-1, 1))
            axes.set_axis_off()
    png = io.BytesIO()
    figure.savefig(png, format="png", dpi=_DPI, metadata={"Software": None})
    write_atomically(path, png.getvalue())


def _view() -> np.ndarray:
    (cy, cx), (sy, sx) = np.cos([_TURN, _TILT]), np.sin([_TURN, _TILT])
    turn = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    return np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]]) @ turn
