"""The quality of motions on all points of the clouds, measured on the host by KD-trees."""

from __future__ import annotations

import numpy as np
from flax import struct
from jaxtyping import Float

from cfr_jax.geometry import motions
from cfr_jax.refine import all_points
from cfr_jax.refine.surfaces import HostSurface, closest

_ASKED = 1 << 15  # points whose distances are enough to tell motions apart
_SPACINGS = 2.0  # points of one surface are about half the spacing away from each other


@struct.dataclass
class Measured:
    """The part of `quality.Quality` that can be told of millions of points in little time."""

    fitness: Float[np.ndarray, ""]
    inlier_rmse: Float[np.ndarray, ""]
    overlap: Float[np.ndarray, ""]
    moments: Float[np.ndarray, "4 4"]


def measure(
    source: HostSurface, target: HostSurface, transform: Float[np.ndarray, "4 4"], distance: float
) -> Measured:
    """Fitness, inlier error, overlap and moments of `transform` (source onto target), in float64,
    as `quality.measure` defines them: points within `distance` are inliers."""
    rows, away = closest(source, target, transform)
    inlier = away <= distance
    near = away[inlier]
    partners = target.points[rows[inlier]]
    partners = np.concatenate([partners, np.ones((len(partners), 1))], axis=1)
    return Measured(
        fitness=np.asarray(np.mean(inlier)),
        inlier_rmse=np.asarray(np.sqrt(np.mean(near**2)) if len(near) else 0.0),
        overlap=np.asarray(np.mean(away <= 2 * target.tree.spacing)),
        moments=partners.T @ partners,
    )


def misfit(
    source: HostSurface, target: HostSurface, transform: Float[np.ndarray, "4 4"], distance: float
) -> float:
    """How badly two clouds lie on each other under `transform` (source onto target), in [0, 1].

    The mean of two losses: of the source's points to the target and of the target's points to the
    source, each `all_points.score`, cut at twice the wider spacing of the two clouds, and at
    `distance` at the most. One way alone, a small part lies well on any dense part of a large
    cloud. Of clouds of more than `_ASKED` points only every second, third, ... one is asked.
    """
    cut = min(distance, _SPACINGS * max(source.tree.spacing, target.tree.spacing))
    ways = (source, target, transform), (target, source, motions.inverse(transform))
    return sum(
        all_points.score(to.tree.closest(motions.apply(motion, _asked(cloud)))[1], cut)
        for cloud, to, motion in ways
    ) / len(ways)


def _asked(cloud: HostSurface) -> Float[np.ndarray, "n 3"]:
    return cloud.points[:: -(-len(cloud.points) // _ASKED)]
