"""Fuses all scans into one cloud: the mean point of each cube of a grid, scan after scan.

Memory holds one scan at a time and the cloud fused so far. The scans are read again one by one.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from cfr_jax.data.scans import estimate_normals
from cfr_jax.geometry import motions
from cfr_jax.io import PointCloud, as_point_cloud
from cfr_jax.multiway.answers import Fused, Merged
from cfr_jax.runtime.progress import Progress

_NEIGHBORS = 16  # points that a normal is estimated from if the scans have no normals
_COMPACTED = 1 << 22  # rows that may wait before the cubes of several scans are summed
_MOST_CELLS = 1 << 20  # cells along each axis; three such indices fit in 63 bits


@dataclass(frozen=True, eq=False)
class _Cubes:
    """Sums over the points of each cube. Several rows may belong to one cube."""

    cell: Int[np.ndarray, "n 3"]
    sums: Float[np.ndarray, "n 6"]
    count: Int[np.ndarray, " n"]
    most: Int[np.ndarray, " n"]
    """The number of points from `scan`, the scan that contributed the most."""
    scan: Int[np.ndarray, " n"]


def fuse_models(
    clouds: Sequence[Any], found: Merged, copies: Mapping[int, int], voxel: float, progress: bool
) -> tuple[Fused, ...]:
    """The merged cloud of each component. The caller's `clouds` are read once more. The points of
    scans in `copies` are not used, because they repeat those of another scan."""
    models = []
    with Progress(
        total=len(found.placed), desc="fusing", unit=" scans", disable=not progress
    ) as bar:

        def members(rows: np.ndarray) -> Iterator[tuple[int, PointCloud, np.ndarray]]:
            for row in rows:
                index = int(found.placed[row])
                if index not in copies:  # otherwise the same points would count twice
                    cloud = as_point_cloud(clouds[index], name=found.names[index])
                    yield index, cloud, found.poses[row]
                bar.update()

        for _, rows in found.by_component():
            models.append(fuse(members(rows), voxel))
    return tuple(models)


def fuse(placed: Iterable[tuple[int, PointCloud, Float[np.ndarray, "4 4"]]], voxel: float) -> Fused:
    """Replaces the points in each cube, with edges of length `voxel`, by their mean.

    `placed` yields the index of each scan, its points, and its motion into the model's frame.
    Raises ValueError if the voxel is not positive or far too small for the model, and if there are
    no scans.
    """
    if not (voxel > 0 and math.isfinite(voxel)):
        raise ValueError(f"voxel: got {voxel}, wanted a positive length")
    held: list[_Cubes] = []
    origin, bare, waiting = None, False, 0
    for index, cloud, pose in placed:
        points = motions.apply(pose, cloud.points)
        if origin is None:
            origin = np.floor(points.mean(axis=0) / voxel) * voxel
        normals = np.zeros_like(points)
        if cloud.normals is None:
            bare = True
        else:
            normals = motions.rotate(pose, cloud.normals)
        held.append(_cubes(index, points - origin, normals, voxel))
        waiting += len(held[-1].count)
        if waiting > _COMPACTED:
            held, waiting = [_compacted(held)], 0
    if origin is None:
        raise ValueError("placed: got no scans, wanted at least one")
    cubes = _compacted(held)
    points = cubes.sums[:, :3] / cubes.count[:, None] + origin
    normals = cubes.sums[:, 3:]
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    if bare or not (length > 1e-6).all():
        normals = _estimated(points - origin)
    else:
        normals = normals / length
    return Fused(points, normals, cubes.scan, cubes.count, voxel)


def _cubes(index: int, points: np.ndarray, normals: np.ndarray, voxel: float) -> _Cubes:
    cells = np.floor(points / voxel)
    if np.abs(cells).max() >= _MOST_CELLS / 2:
        raise ValueError(
            f"voxel: got {voxel:g}, wanted at least {np.abs(points).max() * 2 / _MOST_CELLS:.2g} "
            "for a model of this size"
        )
    count = np.ones(len(points), np.int64)
    made = _Cubes(
        cells.astype(np.int64),
        np.concatenate([points, normals], axis=1),
        count,
        count,
        np.full(len(points), index),
    )
    return _summed(made)


def _compacted(held: list[_Cubes]) -> _Cubes:
    joined = _Cubes(
        *(
            np.concatenate([getattr(each, name) for each in held])
            for name in ("cell", "sums", "count", "most", "scan")
        )
    )
    return _summed(joined)


def _summed(cubes: _Cubes) -> _Cubes:
    """The same sums with a single row for each cube, in the order of the cubes."""
    shifted = cubes.cell + _MOST_CELLS // 2
    key = (shifted[:, 0] * _MOST_CELLS + shifted[:, 1]) * _MOST_CELLS + shifted[:, 2]
    # within a cube, the scan that contributed the most comes first
    order = np.lexsort((cubes.scan, -cubes.most, key))
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    first = order[starts]
    # each scan already has a single row per cube, unless its own points are being summed now
    own = np.add.reduceat(cubes.count[order], starts)
    same = cubes.scan[order] == np.repeat(cubes.scan[first], np.diff([*starts, len(order)]))
    most = np.add.reduceat(np.where(same, cubes.most[order], 0), starts)
    return _Cubes(
        cubes.cell[first],
        np.add.reduceat(cubes.sums[order], starts, axis=0),
        own,
        most,
        cubes.scan[first],
    )


def _estimated(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    if len(points) < 3:
        return np.tile([0.0, 0.0, 1.0], (len(points), 1))
    inward = estimate_normals(
        points, math.inf, _NEIGHBORS, viewpoint=tuple(points.mean(axis=0).tolist())
    )
    return -inward
