"""Scans as this room keeps them: few points, centered, with normals and a tree.

A thousand scans fit in memory, because of each only some thousand points are kept. All points are
read again where the merged cloud is made.
"""

from __future__ import annotations

import functools
import hashlib
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from cfr_jax.data.scans import estimate_normals
from cfr_jax.geometry import units
from cfr_jax.io import PointCloud, as_point_cloud

KEPT = 8192  # points of a scan that are kept; the network sees 1,024 of them
_NEIGHBORS = 16  # of a normal
# Scans of one thing differ less in radius; millimeters among meters differ more.
_SIZES_APART = 20.0


@dataclass(frozen=True, eq=False)
class Scan:
    """A scan, thinned."""

    index: int
    """Its place in the input."""
    name: str
    cloud: PointCloud
    """The thinned points, in the caller's frame and unit."""
    center: Float[np.ndarray, " 3"]
    radius: float
    digest: str
    """Of all its points: equal for scans that are the same."""
    total: int
    """How many points it has unthinned."""

    @functools.cached_property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """Relative to the center, in random order: the first of them are a fair choice."""
        return self.cloud.points[self._order] - self.center

    @functools.cached_property
    def normals(self) -> Float[np.ndarray, "n 3"]:
        """Unit normals of `points`."""
        if self.cloud.normals is not None:
            return self.cloud.normals[self._order]
        return estimate_normals(self.points, math.inf, _NEIGHBORS)

    @functools.cached_property
    def tree(self) -> cKDTree:
        """Of `points`."""
        return cKDTree(self.points)

    @functools.cached_property
    def spacing(self) -> float:
        """Median distance of a point to its nearest neighbor."""
        return float(np.median(self.tree.query(self.points[:1000], k=2)[0][:, 1]))

    @property
    def full_spacing(self) -> float:
        """About that distance among all of its points, not only the thinned ones, on a surface."""
        return self.spacing * float(np.sqrt(len(self.cloud) / self.total))

    @property
    def _order(self) -> np.ndarray:
        return np.random.default_rng(0).permutation(len(self.cloud))


@dataclass(frozen=True)
class LeftOut:
    """A scan without a pose."""

    index: int
    name: str
    reason: str


def name_of(cloud: Any, index: int) -> str:
    """What to call an input: the name of a file or cloud, or its number."""
    if isinstance(cloud, (str, os.PathLike)):
        return Path(cloud).name
    return cloud.name if isinstance(cloud, PointCloud) else f"scan {index}"


def names_of(clouds: Sequence[Any]) -> tuple[str, ...]:
    """A name for each input, all different: files of one name get their folders' names, too."""
    names = [name_of(cloud, index) for index, cloud in enumerate(clouds)]
    for index, cloud in enumerate(clouds):
        if names.count(name_of(cloud, index)) > 1:
            path = isinstance(cloud, (str, os.PathLike))
            names[index] = os.fspath(cloud) if path else f"{names[index]} ({index})"
    if len(set(names)) < len(names):
        names = [f"{name} ({index})" for index, name in enumerate(names)]
    return tuple(names)


def load(clouds: Sequence[Any], names: Sequence[str], *, seed: int) -> Iterator[Scan | LeftOut]:
    """Each input as a scan, or why it cannot be one. A file is read and let go."""
    for index, (given, name) in enumerate(zip(clouds, names, strict=True)):
        try:
            cloud = as_point_cloud(given, name=name)
            if len(cloud) < _NEIGHBORS + 1:
                raise ValueError(f"got {len(cloud)} points, wanted at least {_NEIGHBORS + 1}")
            frames = units.unit_frames(cloud, cloud, None)
        except (ValueError, OSError) as error:
            yield LeftOut(index, name, str(error).removeprefix(f"{name}: "))
            continue
        rows = units.subsample(cloud.points, KEPT, seed)
        normals = None if cloud.normals is None else cloud.normals[rows]
        yield Scan(
            index,
            name,
            PointCloud(cloud.points[rows], normals, name),
            frames.source_center,
            frames.scale,
            hashlib.sha256(cloud.points.tobytes()).hexdigest()[:16],
            len(cloud),
        )


def of_other_sizes(scans: Sequence[Scan]) -> list[LeftOut]:
    """Scans so much larger or smaller than most that they must be in another unit."""
    if len(scans) < 3:
        return []
    usual = float(np.median([scan.radius for scan in scans]))
    return [
        LeftOut(
            scan.index,
            scan.name,
            f"its radius is {scan.radius:.3g}, that of most scans is {usual:.3g}: same units?",
        )
        for scan in scans
        if not usual / _SIZES_APART < scan.radius < usual * _SIZES_APART
    ]


def twins(scans: Sequence[Scan]) -> dict[int, int]:
    """Scans with exactly the points of an earlier one, by index, and that one's index."""
    first: dict[str, int] = {}
    found = {}
    for scan in scans:
        original = first.setdefault(scan.digest, scan.index)
        if original != scan.index:
            found[scan.index] = original
    return found
