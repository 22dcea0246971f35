"""Finds out whether another motion fits as well as an answer, where a small nudge cannot tell.

A nudge has about the size of the inlier distance. If the clouds are sparse, its effect depends on
the samples and not on the surface. If the points lie near the axis of a turn, it hardly moves them.
And no nudge reaches another place where the shapes fit. So the source is turned far away from the
answer and brought back by iterative closest points. A solid of revolution stays turned and fits as
well as before; a cube comes to rest on other sides.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from cfr_jax.geometry import motions
from cfr_jax.geometry.trees import Tree
from cfr_jax.refine.generalized_icp import CUT

# Measured on pairs of samplings of 500 to 1,000 points. For eight solids of revolution, the best
# turned motion fitted at least 0.97 times as well as the right one; for stacks of boxes, at most
# 0.93 times. With 120 points this does not separate them reliably, and with 60 not at all.
_TURNED = 0.95
# Of 171 right and trusted answers on partial, noisy validation pairs, no motion at least 20 degrees
# away fitted 0.9 times as well, and two fitted 0.88 times; of four wrong ones, two had such a
# motion. Two samplings of 500 points differ by about 0.05 in how well one motion fits.
_RIVAL = 0.9
_TURN = np.radians(30.0)  # as far as from the middle of the network's reach to its edge
_APART = 10.0  # degrees between a free turn and the answer
_REACH = 1.5  # the reach of a fit, in point spacings: sparse clouds still feel a surface
_WIDEST = 0.3  # the first cut of iterative closest points, in units of the unit sphere
_STEPS = 12  # of iterative closest points, ...
_APPROACH = 8  # ... the first of them with only some of the points
_MOST = 512  # points of each cloud that are used
_FEWEST = 6  # pairs that a step needs

# Turns over the whole of SO(3): no rotation is farther than 28 degrees from one of them.
_ROTATIONS = motions.cover(600)
_TRIED = 16  # of them are brought nearer, ...
_BEST = 6  # ... and the best of these to rest
_SAME = 20.0  # degrees between turns that end in one place
_COARSE = 0.15  # the reach of a fit of turned clouds that are not yet at rest
_CELLS = 24  # of the grid of distances, along each side of ...
_SIDE = 2.6  # ... a cube that holds both clouds
_EVERY = 4  # one point in so many is used before the last steps

Motion = Float[np.ndarray, "4 4"]


class _Ends(NamedTuple):
    """Motions at which iterative closest points ended, and how well each fits."""

    motions: Float[np.ndarray, "k 4 4"]
    fits: Float[np.ndarray, " k"]


class _AllEnds(NamedTuple):
    own: _Ends
    """Of the answer: as it is, and where it comes to rest."""
    turned: _Ends
    """Of its turns about the principal axes."""
    far: _Ends
    """Of its far turns."""


class Surroundings:
    """What lies around an answer: other motions that fit as well.

    Both clouds lie in the unit sphere. All motions map source onto target. Only motions whose
    rotations are at most `within` degrees from that of `start` count as rivals.
    """

    def __init__(
        self,
        source: Float[np.ndarray, "n 3"],
        target: Float[np.ndarray, "m 3"],
        transform: Float[np.ndarray, "4 4"],
        *,
        start: Float[np.ndarray, "4 4"],
        within: float,
    ):
        self._source, self._target = (Tree(_fewer(cloud)) for cloud in (source, target))
        self._transform, self._start, self._within = transform, start, within
        self._reach = max(CUT, _REACH * max(self._source.spacing, self._target.spacing))
        self._cuts = np.geomspace(max(_WIDEST, self._reach), self._reach, _STEPS)
        self._some = self._source.points[::_EVERY]

    def free_turn(self) -> Float[np.ndarray, " 6"] | None:
        """The twist from the answer to another motion that fits as well, or None if there is none.

        The twist has its rotation first and is in the target's frame. Turns by 30 degrees about the
        principal axes of the source are tried.
        """
        others, fits = self._ends.turned
        free = (fits >= _TURNED * self._own_fit) & (self._away(others) > _APART)
        if not free.any():
            return None
        twist = motions.to_rotvec(others[free.argmax(), :3, :3] @ self._transform[:3, :3].T)
        return np.concatenate([twist / np.linalg.norm(twist), np.zeros(3)])

    def rivals(self) -> Float[np.ndarray, "r 4 4"]:
        """Motions far from the answer that fit at least 0.9 times as well, the best one first.

        The source is turned by rotations that cover SO(3), about the middle of its points that lie
        on the target. The turns that fit best, told by a grid of distances to the target, are
        brought to rest by iterative closest points.
        """
        others, fits = self._ends.far
        counts = (fits >= _RIVAL * self._own_fit) & (self._away(others) > _SAME)
        counts &= motions.angle_between(others, self._start) <= self._within
        return _apart(others[counts], fits[counts], _BEST)

    @property
    def _own_fit(self) -> float:
        """The fit of the answer, or of the place near it where it comes to rest, if that is
        better."""
        places, fits = self._ends.own
        return float(fits[self._away(places) < _APART].max())

    @functools.cached_property
    def _ends(self) -> _AllEnds:
        """All motions take their steps together, which takes half the time of one after the
        other."""
        moved = motions.apply(self._transform, self._source.points)
        answer, axes, far = self._transform[None], self._about_axes(moved), self._far_turns(moved)
        first = 1 + len(axes)
        approached = self._stepped(
            np.concatenate([answer, axes, far]), self._some, self._cuts[:_APPROACH]
        )
        near = _apart(approached[first:], self._fit(approached[first:]), _BEST)
        rested = self._stepped(
            np.concatenate([approached[:first], near]), self._source.points, self._cuts[_APPROACH:]
        )
        found = np.concatenate([answer, rested])
        fits = self._fit(found)
        own, turned, others = np.split(np.arange(len(found)), [2, 1 + first])
        return _AllEnds(*(_Ends(found[rows], fits[rows]) for rows in (own, turned, others)))

    def _about_axes(self, moved: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "6 4 4"]:
        """The answer, turned about the principal axes of the moved source."""
        axes = np.linalg.eigh(np.cov(moved.T))[1].T
        turns = motions.from_rotvec(_TURN * np.concatenate([axes, -axes]))
        return _about(moved.mean(axis=0), turns) @ self._transform

    def _far_turns(self, moved: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k 4 4"]:
        """The turns of the moved source over all of SO(3) that fit best."""
        near = self._target.closest(moved)[1] <= self._reach
        center = moved[near if near.any() else slice(None)].mean(axis=0)
        turned = _about(center, _ROTATIONS) @ self._transform
        # what ends within the limit may start a little beyond it
        allowed = motions.angle_between(turned, self._start) <= self._within + _SAME
        turned = turned[allowed & (self._away(turned) > _SAME)]
        away = self._looked_up(_moved(turned, self._some))
        fits = np.mean(np.maximum(1 - (away / max(_COARSE, self._reach)) ** 2, 0), axis=1)
        return _apart(turned, fits, _TRIED)

    def _away(self, others: Float[np.ndarray, "k 4 4"]) -> Float[np.ndarray, " k"]:
        """The angles between motions and the answer, in degrees."""
        return motions.angle_between(others, self._transform)

    def _fit(self, others: Float[np.ndarray, "k 4 4"]) -> Float[np.ndarray, " k"]:
        """The mean over both clouds of 1 - d^2 / reach^2, where d is the distance to the other
        cloud. Points beyond the reach count as zero."""
        back = np.linalg.inv(others)
        _, there = _closest(self._target, _moved(others, self._source.points))
        _, here = _closest(self._source, _moved(back, self._target.points))
        shares = [np.mean(np.maximum(1 - (d / self._reach) ** 2, 0), axis=1) for d in (there, here)]
        return np.mean(shares, axis=0)

    def _stepped(
        self,
        found: Float[np.ndarray, "k 4 4"],
        points: Float[np.ndarray, "n 3"],
        cuts: Float[np.ndarray, " s"],
    ) -> Float[np.ndarray, "k 4 4"]:
        """The motions after a step of iterative closest points for each cut. Where too few pairs
        are left, nothing moves."""
        for cut in cuts:
            moved = _moved(found, points)
            rows, away = _closest(self._target, moved)
            near = away <= cut
            enough = np.count_nonzero(near, axis=1) >= _FEWEST
            step = _fitted(moved, self._target.points[rows], near | ~enough[:, None])
            found = np.where(enough[:, None, None], step @ found, found)
        return found

    def _looked_up(self, points: Float[np.ndarray, "k n 3"]) -> Float[np.ndarray, "k n"]:
        """The distances of many points to the target, from a grid of distances: a lookup instead
        of a search for each."""
        middles = (np.arange(_CELLS) + 0.5) / _CELLS * _SIDE - _SIDE / 2
        grid = np.stack(np.meshgrid(middles, middles, middles, indexing="ij"), axis=-1)
        away = self._target.closest(grid.reshape(-1, 3))[1]
        cells = np.clip(((points / _SIDE + 0.5) * _CELLS).astype(np.int32), 0, _CELLS - 1)
        return away[cells @ np.array([_CELLS**2, _CELLS, 1], np.int32)]


def _fewer(points: np.ndarray) -> np.ndarray:
    """At most `_MOST` of the points, chosen at random with a fixed seed."""
    return points[np.sort(np.random.default_rng(0).permutation(len(points))[:_MOST])]


def _about(center: np.ndarray, turns: Float[np.ndarray, "k 3 3"]) -> Float[np.ndarray, "k 4 4"]:
    """Turns about a center."""
    return motions.motion(turns, center - turns @ center)


def _apart(
    found: Float[np.ndarray, "k 4 4"], fits: Float[np.ndarray, " k"], most: int
) -> Float[np.ndarray, "r 4 4"]:
    """The motion that fits best, then the best of those that differ from it, and so on."""
    kept = np.zeros((0, 4, 4))
    for motion in found[np.argsort(-fits, kind="stable")]:
        if len(kept) < most and (motions.angle_between(kept, motion) > _SAME).all():
            kept = np.concatenate([kept, motion[None]])
    return kept


def _moved(
    others: Float[np.ndarray, "k 4 4"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "k n 3"]:
    """The points under each of several motions."""
    return points @ others[:, :3, :3].swapaxes(1, 2) + others[:, None, :3, 3]


def _closest(
    tree: Tree, points: Float[np.ndarray, "k n 3"]
) -> tuple[Int[np.ndarray, "k n"], Float[np.ndarray, "k n"]]:
    """`Tree.closest` of several clouds at once."""
    rows, away = tree.closest(points.reshape(-1, 3))
    return rows.reshape(points.shape[:2]), away.reshape(points.shape[:2])


def _fitted(
    points: Float[np.ndarray, "k n 3"],
    places: Float[np.ndarray, "k n 3"],
    counted: Bool[np.ndarray, "k n"],
) -> Float[np.ndarray, "k 4 4"]:
    """The motions that bring the points that count closest to their places (Kabsch, 1976)."""
    share = (counted / np.count_nonzero(counted, axis=1, keepdims=True))[:, None]
    center, goal = share @ points, share @ places
    spread = (places - goal).swapaxes(1, 2) @ (share.swapaxes(1, 2) * (points - center))
    turns = motions.nearest_rotation(spread)
    return motions.motion(turns, (goal - center @ turns.swapaxes(1, 2))[:, 0])
