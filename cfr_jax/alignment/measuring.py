"""The quality of motions on all points of the clouds, measured on the host with KD-trees."""

from __future__ import annotations

import numpy as np
from flax import struct
from jaxtyping import Float

from cfr_jax.geometry import motions
from cfr_jax.geometry.trees import Tree
from cfr_jax.refine.generalized_icp import CUT
from cfr_jax.refine.surfaces import HostSurface, closest, score

_ASKED = 1 << 15  # the distances of this many points are enough to tell motions apart
_SPACINGS = 2.0  # points of aligned surfaces lie about half the spacing away from each other

# The root mean square displacement of an object's points under a turn of one radian or a slide of
# one unit. Nudges that move the points less than this are too small for the inlier distance.
_LEVER = 0.45
_FARTHEST = 6.0  # the largest factor by which a nudge is scaled up
_SMALL, _LARGE = 0.06, 0.15  # the sizes of nudges, as in `quality`
_LEAST = 0.2  # as in `quality`


@struct.dataclass
class Measured:
    """The part of `quality.Quality` that can be measured quickly on millions of points."""

    fitness: Float[np.ndarray, ""]
    inlier_rmse: Float[np.ndarray, ""]
    overlap: Float[np.ndarray, ""]
    moments: Float[np.ndarray, "4 4"]


def measure(
    source: HostSurface, target: HostSurface, transform: Float[np.ndarray, "4 4"], distance: float
) -> Measured:
    """The fitness, inlier error, overlap and moments of `transform` (source onto target), in
    float64. They are defined as in `quality.measure`: points within `distance` are inliers."""
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
    """How badly two clouds fit under `transform` (source onto target), in [0, 1].

    It is the mean of two losses: from the source's points to the target, and from the target's
    points to the source. Each is a `surfaces.score`. Its cut is twice the wider of the two point
    spacings, but at most `distance`. Both directions are needed because a small part fits well on
    any dense part of a large cloud. If a cloud has more than `_ASKED` points, only every second,
    third, ... point is used.
    """
    cut = min(distance, _SPACINGS * max(source.tree.spacing, target.tree.spacing))
    ways = (source, target, transform), (target, source, motions.inverse(transform))
    return sum(
        score(to.tree.closest(motions.apply(motion, _asked(cloud)))[1], cut)
        for cloud, to, motion in ways
    ) / len(ways)


def resistance(
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "m 3"],
    transform: Float[np.ndarray, "4 4"],
    twists: Float[np.ndarray, "w 6"],
) -> Float[np.ndarray, " w"]:
    """The resistance along `twists`, as `quality.measure` defines it, but with nudges that are
    scaled up until they move the source's points as far as they would move those of an object."""
    tree, moved = Tree(target), motions.apply(transform, source)

    def lost(points: np.ndarray) -> float:
        return float(np.mean(np.minimum(tree.closest(points)[1] / CUT, 1) ** 2))

    found = []
    for twist in twists:
        step = np.cross(twist[:3], moved) + twist[3:]
        lever = np.sqrt(np.mean(np.sum(step**2, axis=1)))
        scale = float(np.clip(_LEVER / max(lever, 1e-9), 1, _FARTHEST))
        nudged = [
            lost(_nudged(moved, scale * size * twist))
            for size in (-_SMALL, _SMALL, -_LARGE, _LARGE)
        ]
        near = (nudged[0] + nudged[1]) / 2
        rise = min(nudged[2:]) - near
        found.append(np.clip(rise / max(1 - near, _LEAST), 0, 1))
    return np.array(found)


def _asked(cloud: HostSurface) -> Float[np.ndarray, "n 3"]:
    return cloud.points[:: -(-len(cloud.points) // _ASKED)]


def _nudged(points: np.ndarray, twist: np.ndarray) -> np.ndarray:
    """The points moved along a twist, exact up to the third order of its angle."""
    turn = motions.from_rotvec(twist[:3])
    half = motions.from_rotvec(twist[:3] / 2)
    return points @ turn.T + half @ twist[3:]
