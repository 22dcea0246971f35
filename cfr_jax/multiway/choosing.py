"""Which pairs of scans to register, and in which direction."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from cfr_jax.geometry import motions, twists
from cfr_jax.multiway.scans import Scan

# Neighbors in a sequence, and their neighbors: without these, no edge would be in a cycle of three.
AHEAD = 2
_OVERLAP = 0.3  # of the smaller scan: less is little to register by
_PROBED = 200  # points of a scan by which an overlap is estimated
_REACH = 2.0  # spacings; a point with another one so near was seen by both
_NEAREST = 24  # scans whose overlap with a scan is looked at


@dataclass(frozen=True, eq=False)
class Try:
    """A pair of scans, by index, to be registered."""

    source: int
    target: int
    initial: Float[np.ndarray, "4 4"] | None = None
    """Where the source starts, in the caller's frames."""


def all_pairs(scans: Sequence[Scan]) -> list[Try]:
    """Every scan with every other."""
    return _ordered(scans, itertools.combinations(scans, 2))


def in_sequence(scans: Sequence[Scan], ahead: int = AHEAD) -> list[Try]:
    """Every scan with the next ones."""
    places = [
        (scans[row], scans[row + gap])
        for gap in range(1, ahead + 1)
        for row in range(len(scans) - gap)
    ]
    return _ordered(scans, places)


def from_guesses(tries: Iterable[Try], guesses: dict[int, Float[np.ndarray, "4 4"]]) -> list[Try]:
    """The same pairs, started where guessed poses lay them, if both are guessed."""
    return [
        Try(pair.source, pair.target, np.linalg.inv(guesses[pair.target]) @ guesses[pair.source])
        if pair.source in guesses and pair.target in guesses
        else pair
        for pair in tries
    ]


def overlapping(
    scans: Sequence[Scan], poses: Float[np.ndarray, "n 4 4"], most: int
) -> Int[np.ndarray, "p 2"]:
    """Pairs of rows whose scans overlap where the poses lay them: of each scan the `most` best."""
    places = poses[:, :3, 3]
    radii = np.array([scan.radius for scan in scans])
    found: dict[tuple[int, int], float] = {}
    for row, scan in enumerate(scans):
        away = np.linalg.norm(places - places[row], axis=1)
        away[row] = np.inf
        near = [k for k in np.argsort(away)[:_NEAREST] if away[k] < radii[row] + radii[k]]
        shares = {int(other): _overlap(scan, scans[other], poses[row], poses[other])
                  for other in near}  # fmt: skip
        best = sorted(shares, key=lambda other: -shares[other])[:most]
        for other in best:
            if shares[other] >= _OVERLAP:
                found[min(row, other), max(row, other)] = shares[other]
    return np.array(sorted(found), np.int64).reshape(-1, 2)


def brought_together(
    scans: Sequence[Scan],
    poses: Float[np.ndarray, "n 4 4"],
    known: set[frozenset[int]],
    most: int,
) -> list[Try]:
    """Pairs that overlap where the poses lay them, and were not tried: closures of loops."""
    rows = [
        (first, second)
        for first, second in overlapping(scans, poses, most)
        if frozenset((scans[first].index, scans[second].index)) not in known
    ]
    place = {scan.index: pose for scan, pose in zip(scans, poses, strict=True)}
    tries = _ordered(scans, [(scans[first], scans[second]) for first, second in rows])
    center = {scan.index: scan.center for scan in scans}
    made = []
    for pair in tries:
        between = twists.inverse(place[pair.target]) @ place[pair.source]
        made.append(
            Try(
                pair.source,
                pair.target,
                to_caller(between, center[pair.source], center[pair.target]),
            )
        )
    return made


def to_caller(
    between: Float[np.ndarray, "4 4"],
    source_center: Float[np.ndarray, " 3"],
    target_center: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, "4 4"]:
    """A motion between centered scans as one of the caller's clouds."""
    turn = between[:3, :3]
    return motions.motion(turn, target_center + between[:3, 3] - turn @ source_center)


def to_centered(
    transform: Float[np.ndarray, "4 4"],
    source_center: Float[np.ndarray, " 3"],
    target_center: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, "4 4"]:
    """The inverse of `to_caller`."""
    return motions.motion(
        transform[:3, :3], motions.apply(transform, source_center) - target_center
    )


def _ordered(scans: Sequence[Scan], places: Iterable[tuple[Scan, Scan]]) -> list[Try]:
    """Each onto the larger of the two, those with one target after each other.

    A pair is scaled by its larger scan. So a target is the same for all of its sources, and is
    encoded once.
    """
    tries = []
    for first, second in places:
        source, target = sorted((first, second), key=lambda scan: (scan.radius, scan.index))
        tries.append(Try(source.index, target.index))
    return sorted(tries, key=lambda pair: (pair.target, pair.source))


def _overlap(first: Scan, second: Scan, first_pose: np.ndarray, second_pose: np.ndarray) -> float:
    """Share of the scan that lies on the other; the larger of the two shares."""
    reach = _REACH * max(first.spacing, second.spacing)
    shares = []
    for one, other, motion in (
        (first, second, twists.inverse(second_pose) @ first_pose),
        (second, first, twists.inverse(first_pose) @ second_pose),
    ):
        moved = motions.apply(motion, one.points[:_PROBED])
        shares.append(np.isfinite(other.tree.query(moved, distance_upper_bound=reach)[0]).mean())
    return float(max(shares))
