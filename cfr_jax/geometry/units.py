"""From a user's clouds to the network's, and back: frame, scale, budget, normals, padding.

This runs on the host in float64. At map coordinates (5e6 m) float32 resolves half a meter, so
everything in the caller's frame is computed here. The device only sees centered clouds of unit
size.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from cfr_jax.geometry import motions
from cfr_jax.geometry.neighbors import nearest_on_host
from cfr_jax.geometry.thinning import first_of_each_place, repeated, subsample
from cfr_jax.io import PointCloud

# Sizes that clouds are padded to, so that a new cloud rarely needs a new compilation. Steps of
# about a third waste little.
_BUCKETS = tuple(
    size
    for power in range(7, 21)
    for size in (2**power, 2**power * 4 // 3 // 32 * 32, 2**power * 5 // 3 // 32 * 32)
)
_OUTER = 0.995  # this share of the points lies in the unit sphere; stray points may lie outside
_STRAY = 4.0  # points farther out are sensor errors and would dominate the network's input
# What lies beyond a gap in the distances, each point this many times as far out as the one before,
# has no part in the size of a cloud, if that is no more than this share of the points. Without a
# gap, this many median distances are the limit: LiDAR scans reach ten of them.
_GAP, _FEW, _MEDIANS = 4.0, 0.05, 30.0
FARTHEST = 1e3  # largest distance between the clouds, in radii; float32 resolves it with ease


@dataclass(frozen=True)
class Frames:
    """Maps unit-size clouds to the caller's coordinates: x = center + scale * unit."""

    source_center: Float[np.ndarray, " 3"]
    target_center: Float[np.ndarray, " 3"]
    scale: float
    initial: Float[np.ndarray, "4 4"]
    """Applied to the caller's source before it is centered."""
    size_ratio: float
    """Radius of the source divided by the radius of the target."""
    strays: tuple[int, int] = (0, 0)
    """How many points of the source and of the target lie more than four of their radii out."""

    def to_caller(self, transforms: Float[np.ndarray, "... 4 4"]) -> Float[np.ndarray, "... 4 4"]:
        """Converts motions between the unit clouds to motions of the caller's source onto the
        target."""
        transforms = np.asarray(transforms, np.float64)
        # float32's error of 1e-7 would be visible at a million meters
        rotation = motions.nearest_rotation(transforms[..., :3, :3])
        # rotate about the source's center, so that large coordinates never multiply float32's error
        shift = (
            self.target_center + self.scale * transforms[..., :3, 3] - rotation @ self.source_center
        )
        return motions.motion(rotation, shift) @ self.initial

    def to_unit(self, transforms: Float[np.ndarray, "... 4 4"]) -> Float[np.ndarray, "... 4 4"]:
        """Converts motions of the caller's source to motions between the unit clouds."""
        transforms = np.asarray(transforms, np.float64) @ np.linalg.inv(self.initial)
        turns = transforms[..., :3, :3]
        place = turns @ self.source_center + transforms[..., :3, 3]
        shift = (place - self.target_center) / self.scale
        return motions.motion(motions.nearest_rotation(turns), shift)


@dataclass(frozen=True)
class UnitCloud:
    """A cloud ready for the device: of unit size, within the budget, padded to a bucket."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"] | None
    neighbors: Int[np.ndarray, "n k"] | None
    """None where the device is to find them."""
    mask: Bool[np.ndarray, " n"]
    rows: Int[np.ndarray, " used"]
    """Indices of the used points among the caller's, in order. The padding follows the points."""
    neighbor_count: int
    """How many neighbors each point has."""


def unit_frames(
    source: PointCloud, target: PointCloud, initial: Float[np.ndarray, "4 4"] | None
) -> Frames:
    """Centers and a common scale that bring both clouds into the unit sphere.

    Without an initial motion, each cloud is centered at its own centroid, which removes any offset
    between them. With one, both are placed relative to the target's centroid. Raises ValueError for
    a cloud without extent and for an initial motion that leaves the clouds far apart.
    """
    ours, theirs = (
        _ball(name, cloud.points) for name, cloud in (("source", source), ("target", target))
    )
    source_center, target_center = ours.center, theirs.center
    scale, ratio = max(ours.radius, theirs.radius), ours.radius / theirs.radius
    strays = ours.strays, theirs.strays
    if initial is None:
        return Frames(source_center, target_center, scale, np.eye(4), ratio, strays)
    place = motions.apply(initial, source_center)
    away = float(np.abs(place - target_center).max())
    if not away <= FARTHEST * scale:
        raise ValueError(
            f"initial: leaves the source {away:.3g} away from the target, wanted at most "
            f"{FARTHEST * scale:.3g}, which is {FARTHEST:g} times the radius of the clouds"
        )
    # The initial rotation may be off by rounding, so the nearest proper one is used. It is applied
    # about the source's center: about a distant origin, the slightest turn would move the cloud.
    turn = motions.nearest_rotation(initial[:3, :3])
    exact = motions.motion(turn, place - turn @ source_center)
    return Frames(target_center, target_center, scale, exact, ratio, strays)


def to_unit(
    cloud: PointCloud,
    center: Float[np.ndarray, " 3"],
    scale: float,
    motion: Float[np.ndarray, "4 4"],
    *,
    budget: int,
    neighbors: int,
    radius: float,
    seed: int,
    search: bool = True,
) -> UnitCloud:
    """At most `budget` points of `cloud`, moved, centered, scaled and padded.

    Stray points, more than four radii from the median, are left out. Where many points lie in the
    same places, each place is used once. The neighbors are found here, unless `search` is false: an
    accelerator finds them faster.
    """
    points = (motions.apply(motion, cloud.points) - center) / scale
    near = np.linalg.norm(points - np.median(points, axis=0), axis=1) <= _STRAY
    rows = np.flatnonzero(near)
    used_rows = rows[subsample(points[rows], budget, seed)]
    if repeated(cloud.points[used_rows]):
        places = rows[first_of_each_place(cloud.points[rows])]
        used_rows = places[subsample(points[places], budget, seed)]
    rows = used_rows
    used = points[rows].astype(np.float32)
    count = len(used)
    # a point of a small cloud has no more neighbors than there are others: the rest is padding, too
    size = bucket(count) if count > neighbors + 1 else neighbors + 1
    k = min(neighbors, count - 1)
    pad = ((0, size - count), (0, 0))
    found = np.pad(_neighbors(used, k, radius, neighbors), pad) if search else None
    normals = None
    if cloud.normals is not None:
        normals = motions.rotate(motion, cloud.normals[rows]).astype(np.float32)
        normals = np.pad(normals, pad)
    return UnitCloud(np.pad(used, pad), normals, found, np.arange(size) < count, rows, k)


def _neighbors(
    points: Float[np.ndarray, "n 3"], k: int, radius: float, columns: int
) -> Int[np.ndarray, "n columns"]:
    """The k nearest of each point; in the columns that are left, the nearest one again."""
    found = nearest_on_host(points, k, radius=radius)
    if k == columns:
        return found
    away = np.linalg.norm(points[found] - points[:, None], axis=2)
    nearest = np.take_along_axis(found, away.argmin(axis=1)[:, None], axis=1)
    return np.hstack([found, np.repeat(nearest, columns - k, axis=1)])


def thinned(unit: UnitCloud, *, budget: int, neighbors: int, radius: float, seed: int) -> UnitCloud:
    """At most `budget` points of a unit cloud, in place; `rows` index the points of `unit`."""
    normals = None if unit.normals is None else unit.normals[unit.mask].astype(np.float64)
    cloud = PointCloud(unit.points[unit.mask].astype(np.float64), normals)
    return to_unit(
        cloud,
        np.zeros(3),
        1.0,
        np.eye(4),
        budget=budget,
        neighbors=neighbors,
        radius=radius,
        seed=seed,
        search=unit.neighbors is not None,
    )


def bucket(count: int) -> int:
    """The size that a cloud of `count` points is padded to."""
    return next((size for size in _BUCKETS if size >= count), count)


class _Ball(NamedTuple):
    center: Float[np.ndarray, " 3"]
    radius: float
    strays: int
    """Points more than four radii out."""


def _ball(name: str, points: Float[np.ndarray, "n 3"]) -> _Ball:
    """Center and radius of a cloud without its stray points, which would pull a plain mean away."""
    kept = points[_gathered(points)]
    center = kept.mean(axis=0)
    away = np.linalg.norm(kept - center, axis=1)
    center = kept[away <= np.quantile(away, _OUTER, method="higher")].mean(axis=0)
    radius = float(np.quantile(np.linalg.norm(kept - center, axis=1), _OUTER))
    if not radius > 1e-9 * np.abs(kept).max():
        raise ValueError(
            f"{name}: all of its {len(points)} points lie in one place, "
            "wanted a cloud with some extent"
        )
    out = np.linalg.norm(points - center, axis=1) > _STRAY * radius
    return _Ball(center, radius, int(np.count_nonzero(out)))


def _gathered(points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Which points are not so far out that they would hide the extent of the others.

    The median of the points, and the median of their distances to it, stay where they are as long
    as most points are good; a quantile of 0.995 is lost to one percent of stray points.
    """
    away = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    ordered = np.sort(away)
    middle, few = ordered[len(points) // 2], int(_FEW * len(points))
    tail = ordered[len(points) - 1 - few :]
    if not tail[0] >= middle > 0:  # most points lie in one place, and the others are the extent
        return np.ones(len(points), bool)
    gaps = np.flatnonzero(tail[1:] > _GAP * tail[:-1])
    last = tail[gaps[0]] if len(gaps) else tail[-1]
    within = tail <= min(last, _MEDIANS * middle)
    return away <= tail[within][-1] if within.any() else np.ones(len(points), bool)
