"""Refinement on all points of large clouds, from an answer found on thinned ones.

It is the usual pyramid of voxel grids. The network and the first refinement see a thousand points.
Next comes a grid with eight times as many points, and then the clouds themselves, each with a
narrower cut. The steps are those of `generalized_icp`. The closest points come from a KD-tree on
the host. The sums are taken over a few thousand pairs at a time, so memory use grows only with the
size of the clouds.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfr_jax.geometry import motions, rigid
from cfr_jax.geometry.neighbors import nearest_on_host
from cfr_jax.geometry.normals import estimate_normals
from cfr_jax.geometry.thinning import subsample
from cfr_jax.geometry.units import bucket
from cfr_jax.refine import generalized_icp
from cfr_jax.refine.generalized_icp import CUT, Stage
from cfr_jax.refine.surfaces import Fit, HostSurface, Surface

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_FULLER = 8  # points of the middle level, as a multiple of the points that the network saw
_NEIGHBORS = 24  # points that a normal is estimated from, so the radius shrinks with the spacing
_THICKNESS = generalized_icp.STAGES[-1].thickness
# The cut of a level is this many times the median distance of the pairs that it starts with. That
# median is about half the point spacing where the clouds are aligned, and about the noise where
# they are noisy.
_SPREADS = 4.0
_LEAST_CUT = 1e-4  # for two copies of the same points, whose median distance is zero
_MOST_STEPS = 20
_SETTLED = 1e-6  # radians and units of the unit sphere
_ROWS = 1 << 13


@dataclass(frozen=True, eq=False)
class Level:
    """A cloud thinned to one grid, in the unit sphere."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]

    @functools.cached_property
    def tree(self) -> cKDTree:
        """The KD-tree of the points. Only targets need one."""
        # Importing scipy.spatial takes a fifth of a second, which most calls of `align` can avoid.
        from scipy.spatial import cKDTree

        return cKDTree(self.points)


def refine(source: HostSurface, target: HostSurface, initial: Float[np.ndarray, "4 4"]) -> Fit:
    """Refines `initial`, which maps source onto target within the unit sphere.

    `initial` was found from `thinned_to` points of each surface. The result is kept only if it
    scores no worse than `initial` on all points.
    """
    most = max(len(source.points), len(target.points))
    fuller = _FULLER * max(surface.thinned_to or most for surface in (source, target))
    transform, cut, steps, settled = initial, CUT, 0, False
    for budget in (fuller, most) if fuller < most / 2 else (most,):
        level = _level(source, budget), _level(target, budget)
        cut = _cut(*level, transform, cut)
        transform, taken, settled = _descend(*level, transform, cut)
        steps += taken
    before, after = (_score(*level, motion, cut) for motion in (initial, transform))
    improved = after <= before
    transform = transform if improved else initial
    return Fit(transform, improved, settled, steps)


def _level(surface: HostSurface, budget: int) -> Level:
    def make() -> Level:
        rows = subsample(surface.points, budget, seed=0)
        points, normals = surface.points[rows].astype(np.float32), surface.normals
        normals = _normals(points) if normals is None else normals[rows].astype(np.float32)
        return Level(points, normals)

    return surface.once(("pyramid", min(budget, len(surface.points))), make)


_estimate = jax.jit(estimate_normals)


def _normals(points: np.ndarray) -> np.ndarray:
    k = min(_NEIGHBORS, len(points) - 1)
    pad = ((0, bucket(len(points)) - len(points)), (0, 0))
    near = np.pad(nearest_on_host(points, k, workers=-1), pad)
    return np.asarray(_estimate(np.pad(points, pad), near))[: len(points)]


def _pairs(
    source: Level, target: Level, transform: np.ndarray, cut: float | np.float32
) -> tuple[np.ndarray, np.ndarray]:
    """The distance from each moved source point to its closest target point, and that point's row.
    The distance is infinite beyond the cut."""
    moved = motions.apply(transform, source.points)
    return target.tree.query(moved, distance_upper_bound=cut, workers=-1)


def _cut(source: Level, target: Level, transform: np.ndarray, cut: float) -> float:
    distance, _ = _pairs(source, target, transform, cut)
    near = distance[np.isfinite(distance)]
    return min(cut, max(_LEAST_CUT, _SPREADS * float(np.median(near)))) if len(near) else cut


def _descend(
    source: Level, target: Level, transform: np.ndarray, cut: float
) -> tuple[np.ndarray, int, bool]:
    stage = Stage(*np.array([cut, _THICKNESS], np.float32))
    for step in range(_MOST_STEPS):
        _, index = _pairs(source, target, transform, stage.cut)
        partners = np.minimum(index, len(target.points) - 1)
        twist = _twist(source, target, partners, transform, stage)
        transform = twist @ transform
        if np.abs(twist - np.eye(4)).max() <= _SETTLED:
            return transform, step + 1, True
    return transform, _MOST_STEPS, False


def _twist(
    source: Level, target: Level, index: np.ndarray, transform: np.ndarray, stage: Stage
) -> np.ndarray:
    """One Gauss-Newton step as a motion. Its equations are summed in float64."""
    moving = jnp.asarray(transform, jnp.float32)
    system, pull = np.zeros((6, 6)), np.zeros(6)
    for start in range(0, len(index), _ROWS):
        rows, partners = np.s_[start : start + _ROWS], index[start : start + _ROWS]
        pad = ((0, _ROWS - len(partners)), (0, 0))
        parts = (
            np.pad(part, pad)
            for part in (
                source.points[rows],
                source.normals[rows],
                target.points[partners],
                target.normals[partners],
            )
        )
        more = _equations(*parts, np.arange(_ROWS) < len(partners), moving, stage)
        system, pull = system + np.asarray(more[0]), pull + np.asarray(more[1])
    return np.asarray(_step(system.astype(np.float32), pull.astype(np.float32)), np.float64)


@jax.jit
def _step(system: Array, pull: Array) -> Array:
    return rigid.exp(generalized_icp.solve(system, pull))


@jax.jit
def _equations(
    points: Array, normals: Array, partners: Array, partner_normals: Array, mask: Array,
    transform: Array, stage: Stage,
) -> tuple[Array, Array]:  # fmt: skip
    surface = Surface(points, normals, mask)
    return generalized_icp.normal_equations(surface, partners, partner_normals, transform, stage)


def _score(source: Level, target: Level, transform: np.ndarray, cut: float) -> float:
    """The same score as `generalized_icp.scores`, for one motion, computed with the KD-tree."""
    distance, _ = _pairs(source, target, transform, cut)
    return float(np.mean(1 - (1 - np.minimum(distance / cut, 1) ** 2) ** 3))
