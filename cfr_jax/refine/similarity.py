"""Refines a motion together with a factor of scale: seven unknowns instead of six.

Each step solves for the small similarity that brings pairs of closest points onto each other's
tangent planes (Chen & Medioni, 1991). The pairs are searched both ways, from the source to the
target and back: with pairs of one way alone, a smaller source always fits better.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cfr_jax.geometry import motions
from cfr_jax.refine.generalized_icp import CUT
from cfr_jax.refine.surfaces import HostSurface, score

_NEIGHBORS = 16
_CUTS = (3 * CUT, 2 * CUT, CUT)  # largest distances of pairs, in units of the unit sphere
_STEPS = 12  # for each of them
_MOST = 0.1  # a step changes the factor by no more than this share
_SETTLED = 1e-3  # times the cut
# A little of the distance between the points themselves, besides that between their planes. It
# holds what no plane resists.
_POINTWISE = 1e-3
FEWEST = 7


class Similarity(NamedTuple):
    """The map x -> motion (factor x): the factor comes first, and then a rigid motion."""

    factor: float
    motion: Float[np.ndarray, "4 4"]

    @property
    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """The same map as one (4, 4) matrix."""
        return self.motion @ np.diag([self.factor] * 3 + [1.0])


class Pairs(NamedTuple):
    """Points of the moved source and places on the target that belong together."""

    points: Float[np.ndarray, "p 3"]
    places: Float[np.ndarray, "p 3"]
    normals: Float[np.ndarray, "p 3"]
    """Of the cloud in which the partner was searched, in the target's frame."""
    away: Float[np.ndarray, " p"]
    agreement: Float[np.ndarray, " p"]
    """The cosine between the normals of both points, without its sign."""


def refine(
    source: HostSurface,
    target: HostSurface,
    initial: Similarity,
    *,
    cuts: tuple[float, ...] = _CUTS,
    keep_factor: bool = False,
) -> Similarity:
    """Refines `initial`, which maps source onto target within the unit sphere.

    Pairs further apart than the cut do not count, for each of `cuts` in turn. Where the surfaces
    leave the factor open (a plane on a plane), it stays near where it started; nothing says so
    here. There is no gradient.
    """
    found = initial
    for cut in cuts:
        for _ in range(_STEPS):
            pairs = both_ways(source, target, found)
            weights = np.maximum(1 - (pairs.away / cut) ** 2, 0) ** 2 * pairs.agreement
            if np.count_nonzero(weights) < FEWEST:
                return found
            center = pairs.points.mean(axis=0)
            system, pull = equations(pairs, weights, center)
            free = 6 if keep_factor else 7
            system = system + 1e-9 * np.trace(system) * np.eye(7)
            step = np.zeros(7)
            step[:free] = -np.linalg.solve(system[:free, :free], pull[:free])
            step *= min(1.0, _MOST / max(np.abs(step).max(), 1e-12))
            found = moved_by(found, step, center)
            if np.abs(step).max() < _SETTLED * cut:
                break
    return found


def both_ways(source: HostSurface, target: HostSurface, found: Similarity) -> Pairs:
    """For each point of either cloud, its closest point of the other one under `found`."""
    factor, motion = found
    moved = motions.apply(motion, factor * source.points)
    ours, theirs = motions.rotate(motion, normals_of(source)), normals_of(target)
    rows, there = target.tree.closest(moved)
    inside = motions.apply(motions.inverse(motion), target.points) / factor
    back, here = source.tree.closest(inside)
    return Pairs(
        np.concatenate([moved, moved[back]]),
        np.concatenate([target.points[rows], target.points]),
        np.concatenate([theirs[rows], ours[back]]),
        np.concatenate([there, factor * here]),
        np.abs(np.concatenate([(ours * theirs[rows]).sum(1), (ours[back] * theirs).sum(1)])),
    )


def misfit(source: HostSurface, target: HostSurface, found: Similarity, cut: float) -> float:
    """How badly two clouds fit under `found`, in [0, 1]: the mean over both ways of
    `surfaces.score`, which is 1 if no point of one cloud is within the cut of the other."""
    away = both_ways(source, target, found).away
    ways = away[: len(source.points)], away[len(source.points) :]
    return sum(score(way, cut) for way in ways) / 2


def normals_of(surface: HostSurface) -> Float[np.ndarray, "n 3"]:
    """The normals of a surface, estimated from the nearest points if it has none (Hoppe et al.,
    1992). Their signs are arbitrary."""
    if surface.normals is not None:
        return surface.normals
    return surface.once(("normals", _NEIGHBORS), functools.partial(_estimated, surface))


def _estimated(surface: HostSurface) -> Float[np.ndarray, "n 3"]:
    rows, _ = surface.tree.nearest(surface.points, min(_NEIGHBORS, len(surface.points)))
    near = surface.points[rows]
    near = near - near.mean(axis=1, keepdims=True)
    return np.linalg.eigh(near.swapaxes(1, 2) @ near)[1][:, :, 0]


def equations(
    pairs: Pairs, weights: Float[np.ndarray, " p"], center: Float[np.ndarray, " 3"]
) -> tuple[Float[np.ndarray, "7 7"], Float[np.ndarray, " 7"]]:
    """The normal equations of the distances to tangent planes, for the step of `moved_by`."""
    arm, off, normals = pairs.points - center, pairs.points - pairs.places, pairs.normals
    rows = np.hstack([np.cross(arm, normals), normals, (arm * normals).sum(1, keepdims=True)])
    weighted = rows * weights[:, None]
    system, pull = weighted.T @ rows, weighted.T @ (off * normals).sum(axis=1)
    held, drawn = _pointwise(arm, off, _POINTWISE * weights)
    return system + held, pull + drawn


def _pointwise(
    arm: Float[np.ndarray, "p 3"], off: Float[np.ndarray, "p 3"], weights: Float[np.ndarray, " p"]
) -> tuple[Float[np.ndarray, "7 7"], Float[np.ndarray, " 7"]]:
    """The normal equations of the distances between the points of pairs, in closed form."""
    x, y, z = first = weights @ arm
    second = (arm * weights[:, None]).T @ arm
    lever = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    system = np.zeros((7, 7))
    system[:3, :3] = np.trace(second) * np.eye(3) - second
    system[:3, 3:6], system[3:6, :3] = lever, lever.T
    system[3:6, 3:6] = weights.sum() * np.eye(3)
    system[3:6, 6] = system[6, 3:6] = first
    system[6, 6] = np.trace(second)
    pull = np.concatenate(
        [weights @ np.cross(arm, off), weights @ off, [weights @ (arm * off).sum(1)]]
    )
    return system, pull


def moved_by(
    found: Similarity, step: Float[np.ndarray, " 7"], center: Float[np.ndarray, " 3"]
) -> Similarity:
    """The similarity after a `step` in the target's frame: a turn about `center`, a shift, and the
    log of a factor with `center` as its fixed point."""
    growth, turn = float(np.exp(step[6])), motions.from_rotvec(step[:3])
    rotation, place = found.motion[:3, :3], found.motion[:3, 3]
    shifted = growth * turn @ (place - center) + center + step[3:6]
    return Similarity(
        found.factor * growth, motions.motion(motions.nearest_rotation(turn @ rotation), shifted)
    )
