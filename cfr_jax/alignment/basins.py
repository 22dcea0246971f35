"""Finds out whether another motion near an answer fits as well, where a small nudge cannot tell.

A nudge has about the size of the inlier distance. If the clouds are sparse, its effect depends on
the samples and not on the surface. If the points lie near the axis of a turn, it hardly moves them.
So the source is turned far away from the answer and brought back by iterative closest points. A
solid of revolution stays turned and fits as well as before.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from cfr_jax.geometry import motions
from cfr_jax.geometry.trees import Tree
from cfr_jax.refine.generalized_icp import CUT

# Measured on pairs of samplings of 500 to 1,000 points. For eight solids of revolution, the best
# turned motion fitted at least 0.97 times as well as the right one; for stacks of boxes, at most
# 0.93 times. With 120 points this does not separate them reliably, and with 60 not at all.
RIVAL = 0.95
_TURN = np.radians(30.0)  # as far as from the middle of the network's reach to its edge
_APART = np.radians(10.0)  # motions whose rotations differ by more are different answers
_REACH = 1.5  # the reach of a fit, in point spacings: sparse clouds still feel a surface
_WIDEST = 0.3  # the first cut of iterative closest points, in units of the unit sphere
_STEPS = 12
_MOST = 512  # points of each cloud that are used
_FEWEST = 6  # pairs that a step needs

# The root mean square displacement of an object's points under a turn of one radian or a slide of
# one unit. Nudges that move the points less than this are too small for the inlier distance.
_LEVER = 0.45
_FARTHEST = 6.0  # the largest factor by which a nudge is scaled up
_SMALL, _LARGE = 0.06, 0.15  # the sizes of nudges, as in `quality`
_LEAST = 0.2  # as in `quality`

Motion = Float[np.ndarray, "4 4"]


def free_turn(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "m 3"], transform: Motion
) -> Float[np.ndarray, " 6"] | None:
    """The twist from `transform` to another motion that fits as well, or None if there is none.

    The twist has its rotation first and is in the target's frame. Turns by 30 degrees about the
    principal axes of the source are tried. Both clouds lie in the unit sphere; `transform` maps
    source onto target.
    """
    source, target = (_fewer(cloud) for cloud in (source, target))
    trees = Tree(source), Tree(target)
    spacing = max(tree.spacing for tree in trees)
    reach = max(CUT, _REACH * spacing)
    fit = functools.partial(_mutual, *trees, reach)
    settled = _settled(*trees, transform, reach)
    own = fit(transform)
    if motions.angle_between(settled, transform) < np.degrees(_APART):
        own = max(own, fit(settled))
    for start in _turned(source, transform):
        other = _settled(*trees, start, reach)
        turn = motions.to_rotvec(other[:3, :3] @ transform[:3, :3].T)
        if np.linalg.norm(turn) > _APART and fit(other) >= RIVAL * own:
            return np.concatenate([turn / np.linalg.norm(turn), np.zeros(3)])
    return None


def resistance(
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "m 3"],
    transform: Motion,
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


def _nudged(points: np.ndarray, twist: np.ndarray) -> np.ndarray:
    """The points moved along a twist, exact up to the third order of its angle."""
    turn = motions.from_rotvec(twist[:3])
    half = motions.from_rotvec(twist[:3] / 2)
    return points @ turn.T + half @ twist[3:]


def _fewer(points: np.ndarray) -> np.ndarray:
    return points[np.sort(np.random.default_rng(0).permutation(len(points))[:_MOST])]


def _turned(source: np.ndarray, transform: Motion) -> Iterator[Motion]:
    moved = motions.apply(transform, source)
    center = moved.mean(axis=0)
    for axis in np.linalg.eigh(np.cov(moved.T))[1].T:
        for sign in (-1, 1):
            turn = motions.from_rotvec(sign * _TURN * axis)
            yield motions.motion(turn, center - turn @ center) @ transform


def _mutual(source: Tree, target: Tree, reach: float, transform: Motion) -> float:
    """The mean over both clouds of 1 - d^2 / reach^2, where d is the distance to the other cloud.
    Points beyond the reach count as zero."""
    there = target.closest(motions.apply(transform, source.points))[1]
    back = source.closest(motions.apply(motions.inverse(transform), target.points))[1]
    return float(sum(np.mean(np.maximum(1 - (d / reach) ** 2, 0)) for d in (there, back)) / 2)


def _settled(source: Tree, target: Tree, transform: Motion, reach: float) -> Motion:
    """The motion at which iterative closest points end. The cut on the distance of pairs shrinks
    from `_WIDEST` to `reach`."""
    for cut in np.geomspace(max(_WIDEST, reach), reach, _STEPS):
        moved = motions.apply(transform, source.points)
        rows, away = target.closest(moved)
        near = away <= cut
        if np.count_nonzero(near) < _FEWEST:
            break
        transform = _fitted(moved[near], target.points[rows[near]]) @ transform
    return transform


def _fitted(points: np.ndarray, places: np.ndarray) -> Motion:
    """The motion that brings points closest to their places (Kabsch, 1976)."""
    center, goal = points.mean(axis=0), places.mean(axis=0)
    turn = motions.nearest_rotation((places - goal).T @ (points - center))
    return motions.motion(turn, goal - turn @ center)
