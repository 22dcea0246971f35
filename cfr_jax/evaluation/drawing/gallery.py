"""Pairs to look at: where a method did best, about average, and worst."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from cfr_jax.data.pairs import Pair
from cfr_jax.evaluation.drawing.figures import new_figure, save_figure
from cfr_jax.evaluation.measuring import Measured
from cfr_jax.evaluation.store import Records
from cfr_jax.viewer import Scene
from cfr_jax.viewer.camera import best_view

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_EACH = 3
_MOST_POINTS = 1500
_SOURCE, _TARGET = "#f0a000", "#0090d0"


def chosen(measured: Measured) -> dict[str, list[int]]:
    """The answered pairs with the smallest, the middle, and the largest rotation errors.

    If there are few, a pair appears only in the first row that would show it.
    """
    answered = np.flatnonzero(measured.answered)
    ranked = answered[np.argsort(measured.err_r[answered, -1], kind="stable")].tolist()
    middle = max(0, (len(ranked) - _EACH) // 2)
    rows = {
        "best": ranked[:_EACH],
        "median": ranked[middle : middle + _EACH],
        "worst": ranked[::-1][:_EACH],
    }
    shown: set[int] = set()
    for name, indices in rows.items():
        rows[name] = [index for index in indices if index not in shown]
        shown |= set(rows[name])
    return rows


def draw_gallery(path: Path, measured: Measured, records: Records, pairs: Sequence[Pair]) -> None:
    """Writes a PNG with each chosen pair, before and after; nothing if no pair was answered."""
    rows = chosen(measured)
    if not rows["best"]:
        return
    figure = new_figure(15, 8.4)
    panels = figure.subplots(len(rows), 2 * _EACH, squeeze=False)
    for axes in panels.flat:
        axes.set_axis_off()
    for line, (name, indices) in zip(panels, rows.items(), strict=True):
        for place, index in enumerate(indices):
            pair, found = pairs[index], records.by_pair[index].transforms
            assert found is not None  # only answered pairs are chosen
            scene = Scene(
                source=pair.source,
                target=pair.target,
                transforms=np.stack([np.eye(4), np.array(found[-1])]),
                labels=["before", "after"],
            )
            before, after = line[2 * place : 2 * place + 2]
            _draw(before, scene, 0)
            _draw(after, scene, -1)
            before.set_title(f"{name}: pair {index}", fontsize=9, loc="left")
            error = measured.err_r[index, -1], measured.err_t[index, -1]
            after.set_title(f"{error[0]:.2f}°, {error[1]:.3g}", fontsize=9, loc="left")
    figure.suptitle(f"{measured.name}: source orange, target blue; rotation and translation error")
    save_figure(figure, path)


def _draw(axes: Axes, scene: Scene, station: int) -> None:
    """Draws both clouds, from back to front."""
    view = best_view(scene)
    clouds = [_some(np.asarray(scene.target)), _some(scene.moved(station))]
    points = (np.concatenate(clouds) - view.center) @ view.rotation.T
    colors = np.repeat([_TARGET, _SOURCE], [len(cloud) for cloud in clouds])
    order = np.argsort(points[:, 2], kind="stable")
    axes.scatter(points[order, 0], points[order, 1], s=2.5, c=colors[order], linewidths=0)
    reach = view.radii[station]
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")


def _some(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k 3"]:
    if len(points) <= _MOST_POINTS:
        return points
    return points[np.random.default_rng(0).permutation(len(points))[:_MOST_POINTS]]
