"""Prepares raw scans on the host: thinning, normals, and refined true motions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from cfr_jax.geometry import motions

# Open3D's stopping rule; the published KITTI pairs were refined with Open3D.
SETTLED = 1e-6
MAX_ITERATIONS = 200


class Refined(NamedTuple):
    """A motion of source onto target, and the share of source points it brings near the target."""

    transform: Float[np.ndarray, "4 4"]
    fitness: float


def voxel_mean(points: Float[np.ndarray, "n 3"], size: float) -> Float[np.ndarray, "m 3"]:
    """The mean point of each occupied cube in a grid with edges of length `size`."""
    if not size > 0:
        raise ValueError(f"size: got {size}, wanted a positive length")
    # The grid starts half a cube below the lowest coordinates, as in Open3D.
    offsets = points.astype(np.float64) - points.min(axis=0)
    cubes = np.floor(offsets / size + 0.5).astype(np.int64)
    _, cube, counts = np.unique(cubes, axis=0, return_inverse=True, return_counts=True)
    sums = [np.bincount(cube.reshape(-1), weights=points[:, axis]) for axis in range(3)]
    return (np.stack(sums, axis=1) / counts[:, None]).astype(points.dtype)


def estimate_normals(
    points: Float[np.ndarray, "n 3"],
    radius: float,
    most: int = 30,
    viewpoint: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Float[np.ndarray, "n 3"]:
    """Unit normals that face the viewpoint, which is the sensor in a scan.

    A normal is the direction of least spread (Hoppe et al., 1992) of the nearest points within
    `radius`, at most `most` including the point itself. If fewer than two others lie there, the
    surface is not determined, and the normal is some unit vector.
    """
    most = min(most, len(points))
    distances, rows = cKDTree(points).query(
        points, k=range(1, most + 1), distance_upper_bound=radius
    )
    near = np.isfinite(distances)[..., None]
    offsets = np.where(near, points[np.where(near[..., 0], rows, 0)] - points[:, None], 0.0)
    offsets -= offsets.sum(axis=1, keepdims=True) / near.sum(axis=1, keepdims=True)
    offsets = np.where(near, offsets, 0.0)
    _, directions = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))
    normals = directions[:, :, 0]
    away = np.einsum("ni,ni->n", normals, np.asarray(viewpoint) - points) < 0
    return np.where(away[:, None], -normals, normals).astype(points.dtype)


def refine_point_to_plane(
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "m 3"],
    target_normals: Float[np.ndarray, "m 3"],
    initial: Float[np.ndarray, "4 4"],
    threshold: float,
) -> Refined:
    """Point-to-plane ICP (Chen & Medioni, 1991) from an initial motion, to make true motions.

    Source points farther than `threshold` from the target are ignored. In directions that the
    planes do not constrain, the motion keeps its initial value. If no source point is close enough,
    the iteration ends with the motion it has (at first, the initial one) and fitness 0.
    """
    tree = cKDTree(target)
    transform = np.array(initial, np.float64)
    before = (np.inf, np.inf)
    for _ in range(MAX_ITERATIONS):
        moved = motions.apply(transform, source)
        distances, rows = tree.query(moved, distance_upper_bound=threshold)
        near = np.isfinite(distances)
        fitness = float(near.mean())
        if not fitness:
            return Refined(transform, 0.0)
        rmse = np.sqrt(np.square(distances[near]).mean())
        if abs(fitness - before[0]) < SETTLED and abs(rmse - before[1]) < SETTLED:
            break
        before = fitness, rmse
        transform = (
            _plane_step(moved[near], target[rows[near]], target_normals[rows[near]]) @ transform
        )
    return Refined(transform, fitness)


def _plane_step(
    points: Float[np.ndarray, "n 3"],
    targets: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "4 4"]:
    """The motion that, to first order, brings the points closest to their target planes."""
    center = points.mean(axis=0)
    rows = np.concatenate([np.cross(points - center, normals), normals], axis=1)
    heights = np.einsum("ni,ni->n", targets - points, normals)
    twist, *_ = np.linalg.lstsq(rows.T @ rows, rows.T @ heights, rcond=1e-9)
    turn = motions.from_rotvec(twist[:3])
    return motions.motion(turn, center - turn @ center + twist[3:])
