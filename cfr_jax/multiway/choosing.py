"""Chooses which pairs of scans to register, and in which direction."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from cfr_jax.geometry import motions, twists
from cfr_jax.multiway.scans import Scan

# In a sequence, each scan is tried with the next two. With only the next one, no edge would be in a
# cycle of three.
AHEAD = 2
_OVERLAP = 0.3  # share of a scan that must overlap; less is too little for a registration
_PROBED = 200  # points of a scan from which its overlap is estimated
_REACH = 2.0  # spacings; if another scan has a point within this distance, both saw the place
_NEAREST = 24  # nearest scans whose overlap with a scan is estimated


@dataclass(frozen=True, eq=False)
class Try:
    """A pair of scans to register, given by their indices."""

    source: int
    target: int
    initial: Float[np.ndarray, "4 4"] | None = None
    """The motion from which the registration starts, in the caller's frames."""


def all_pairs(scans: Sequence[Scan]) -> list[Try]:
    """Pairs every scan with every other."""
    return _ordered(scans, itertools.combinations(scans, 2))


def in_sequence(scans: Sequence[Scan], ahead: int = AHEAD) -> list[Try]:
    """Pairs every scan with the `ahead` scans that follow it."""
    places = [
        (scans[row], scans[row + gap])
        for gap in range(1, ahead + 1)
        for row in range(len(scans) - gap)
    ]
    return _ordered(scans, places)


def from_guesses(tries: Iterable[Try], guesses: dict[int, Float[np.ndarray, "4 4"]]) -> list[Try]:
    """The same pairs, each with a start from the guessed poses of its scans if both are guessed."""
    return [
        Try(pair.source, pair.target, np.linalg.inv(guesses[pair.target]) @ guesses[pair.source])
        if pair.source in guesses and pair.target in guesses
        else pair
        for pair in tries
    ]


def overlapping(
    scans: Sequence[Scan], poses: Float[np.ndarray, "n 4 4"], most: int
) -> Int[np.ndarray, "p 2"]:
    """Pairs of rows whose scans overlap under the poses: for each scan, at most the `most` best."""
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
    """Pairs that overlap under the poses but were not tried before: candidates for loop
    closures."""
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
    """Converts a motion between centered scans to one between the caller's clouds."""
    turn = between[:3, :3]
    return motions.motion(turn, target_center + between[:3, 3] - turn @ source_center)


def to_centered(
    transform: Float[np.ndarray, "4 4"],
    source_center: Float[np.ndarray, " 3"],
    target_center: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, "4 4"]:
    """Converts a motion between the caller's clouds to one between centered scans."""
    return motions.motion(
        transform[:3, :3], motions.apply(transform, source_center) - target_center
    )


def _ordered(scans: Sequence[Scan], places: Iterable[tuple[Scan, Scan]]) -> list[Try]:
    """Registers each pair onto its larger scan, and orders the pairs by target.

    A pair is scaled by its larger scan. So a target is scaled the same way for all of its sources,
    and is encoded only once.
    """
    tries = []
    for first, second in places:
        source, target = sorted((first, second), key=lambda scan: (scan.radius, scan.index))
        tries.append(Try(source.index, target.index))
    return sorted(tries, key=lambda pair: (pair.target, pair.source))


def _overlap(first: Scan, second: Scan, first_pose: np.ndarray, second_pose: np.ndarray) -> float:
    """The share of one scan that lies on the other, whichever of the two shares is larger."""
    reach = _REACH * max(first.spacing, second.spacing)
    shares = []
    for one, other, motion in (
        (first, second, twists.inverse(second_pose) @ first_pose),
        (second, first, twists.inverse(first_pose) @ second_pose),
    ):
        moved = motions.apply(motion, one.points[:_PROBED])
        shares.append(np.isfinite(other.tree.query(moved, distance_upper_bound=reach)[0]).mean())
    return float(max(shares))
