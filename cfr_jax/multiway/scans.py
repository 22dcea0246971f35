"""Scans in memory: a few thousand points each, centered, with normals and a KD-tree.

A thousand scans fit in memory, because only a few thousand points of each are kept. All points are
read again when the merged cloud is made.
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
from cfr_jax.geometry import thinning, units
from cfr_jax.io import PointCloud, as_point_cloud

KEPT = 8192  # points that are kept of each scan; the network sees 1,024 of them
_NEIGHBORS = 16  # points that a normal is estimated from
# Scans of one thing differ in radius by less than this factor; millimeters and meters by more.
_SIZES_APART = 20.0


@dataclass(frozen=True, eq=False)
class Scan:
    """A thinned scan."""

    index: int
    """Its place in the input."""
    name: str
    cloud: PointCloud
    """The thinned points, in the caller's frame and unit."""
    center: Float[np.ndarray, " 3"]
    radius: float
    digest: str
    """A hash of all its points, which is equal for scans with the same points."""
    total: int
    """The number of its points before thinning."""

    @functools.cached_property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """The kept points relative to the center, in random order, so that the first few are a
        random sample."""
        return self.cloud.points[self._order] - self.center

    @functools.cached_property
    def normals(self) -> Float[np.ndarray, "n 3"]:
        """The unit normals of `points`."""
        if self.cloud.normals is not None:
            return self.cloud.normals[self._order]
        return estimate_normals(self.points, math.inf, _NEIGHBORS)

    @functools.cached_property
    def tree(self) -> cKDTree:
        """The KD-tree of `points`."""
        return cKDTree(self.points)

    @functools.cached_property
    def spacing(self) -> float:
        """The median distance from a point to its nearest neighbor."""
        return float(np.median(self.tree.query(self.points[:1000], k=2)[0][:, 1]))

    @property
    def full_spacing(self) -> float:
        """An estimate of the spacing of all its points, before thinning, for a surface."""
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
    """The name of an input: the name of its file or cloud, or else its number."""
    if isinstance(cloud, (str, os.PathLike)):
        return Path(cloud).name
    return cloud.name if isinstance(cloud, PointCloud) else f"scan {index}"


def names_of(clouds: Sequence[Any]) -> tuple[str, ...]:
    """A unique name for each input. Files with the same name are called by their paths."""
    names = [name_of(cloud, index) for index, cloud in enumerate(clouds)]
    for index, cloud in enumerate(clouds):
        if names.count(name_of(cloud, index)) > 1:
            path = isinstance(cloud, (str, os.PathLike))
            names[index] = os.fspath(cloud) if path else f"{names[index]} ({index})"
    if len(set(names)) < len(names):
        names = [f"{name} ({index})" for index, name in enumerate(names)]
    return tuple(names)


def load(clouds: Sequence[Any], names: Sequence[str], *, seed: int) -> Iterator[Scan | LeftOut]:
    """Yields each input as a scan, or the reason why it cannot be one. Only the thinned points of a
    file stay in memory."""
    for index, (given, name) in enumerate(zip(clouds, names, strict=True)):
        try:
            cloud = as_point_cloud(given, name=name)
            if len(cloud) < _NEIGHBORS + 1:
                raise ValueError(f"got {len(cloud)} points, wanted at least {_NEIGHBORS + 1}")
            frames = units.unit_frames(cloud, cloud, None)
        except (ValueError, OSError) as error:
            yield LeftOut(index, name, str(error).removeprefix(f"{name}: "))
            continue
        rows = thinning.subsample(cloud.points, KEPT, seed)
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
    """The scans that are so much larger or smaller than most that their unit must be another."""
    if len(scans) < 3:
        return []
    usual = float(np.median([scan.radius for scan in scans]))
    return [
        LeftOut(
            scan.index,
            scan.name,
            f"its radius is {scan.radius:.3g}, but that of most scans is {usual:.3g}: same units?",
        )
        for scan in scans
        if not usual / _SIZES_APART < scan.radius < usual * _SIZES_APART
    ]


def twins(scans: Sequence[Scan]) -> dict[int, int]:
    """Scans with exactly the same points as an earlier one: their index, with the index of the
    earlier one."""
    first: dict[str, int] = {}
    found = {}
    for scan in scans:
        original = first.setdefault(scan.digest, scan.index)
        if original != scan.index:
            found[scan.index] = original
    return found
