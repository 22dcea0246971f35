"""Synthetic surfaces with exact normals, and the motions between them, for the tests of `align`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation


class Sampled(NamedTuple):
    points: np.ndarray
    normals: np.ndarray


# (corner, size): an L-shaped stack with one small tower. No motion but the identity keeps it.
_BOXES = (
    ((0.0, 0.0, 0.0), (1.0, 0.5, 0.3)),
    ((0.0, 0.0, 0.3), (0.35, 0.5, 0.6)),
    ((0.6, 0.1, 0.3), (0.2, 0.15, 0.2)),
)


def lopsided(count: int, seed: int, noise: float = 0.0) -> Sampled:
    """A union of boxes, sampled by area."""
    rng = np.random.default_rng(seed)
    faces = [(box, axis, side) for box in _BOXES for axis in range(3) for side in (0, 1)]
    areas = [np.prod(np.delete(size, axis)) for (_, size), axis, _ in faces]
    drawn = rng.choice(len(faces), count, p=np.divide(areas, np.sum(areas)))
    unit, normals = rng.random((count, 3)), np.zeros((count, 3))
    corners, sizes = np.empty((2, count, 3))
    for number, ((corner, size), axis, side) in enumerate(faces):
        here = drawn == number
        unit[here, axis], normals[here, axis] = side, 2 * side - 1
        corners[here], sizes[here] = corner, size
    points = corners + unit * sizes
    return Sampled(points + noise * rng.normal(size=points.shape), normals)


def two_samplings(count: int, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points of the lopsided shape, noisy, drawn twice; the second moved by `truth`."""
    source, target = (lopsided(count, seed, 0.003).points for seed in (0, 1))
    return source, move(truth, target)


def plane(count: int, seed: int, noise: float = 0.0) -> Sampled:
    """A square of side two about the origin, across z."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3)) * [1, 1, 0]
    normals = np.tile([0.0, 0.0, 1.0], (count, 1))
    return Sampled(points + noise * rng.normal(size=points.shape), normals)


def sphere(count: int, seed: int, noise: float = 0.0) -> Sampled:
    """The unit sphere."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Sampled(normals + noise * rng.normal(size=normals.shape), normals)


def cylinder(count: int, seed: int, noise: float = 0.0) -> Sampled:
    """A tube of radius 0.4 and length two along z."""
    rng = np.random.default_rng(seed)
    angle, height = rng.uniform(0, 2 * np.pi, count), rng.uniform(-1, 1, count)
    normals = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    points = 0.4 * normals + height[:, None] * [0, 0, 1]
    return Sampled(points + noise * rng.normal(size=points.shape), normals)


def line(count: int, seed: int, noise: float = 0.0) -> Sampled:
    """A segment of length two along x; its normals are any across it."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 1)) * [1.0, 0.0, 0.0]
    normals = np.tile([0.0, 0.0, 1.0], (count, 1))
    return Sampled(points + noise * rng.normal(size=points.shape), normals)


def motion(degrees: float, axis=(1.0, 2.0, 3.0), translation=(0.3, -0.2, 0.5)) -> np.ndarray:
    """A turn about `axis` through the origin, then a translation."""
    transform = np.eye(4)
    turn = np.deg2rad(degrees) * np.array(axis) / np.linalg.norm(axis)
    transform[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    transform[:3, 3] = translation
    return transform


def move(transform: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ transform[:3, :3].T + transform[:3, 3]


def degrees_between(first: np.ndarray, second: np.ndarray) -> float:
    turn = Rotation.from_matrix(first[:3, :3].T @ second[:3, :3])
    return float(np.rad2deg(turn.magnitude()))


def keep_side(sampled: Sampled, direction, share: float) -> Sampled:
    """The `share` of the points that lies furthest along `direction`."""
    along = sampled.points @ np.asarray(direction, float)
    kept = along >= np.quantile(along, 1 - share)
    return Sampled(*(part[kept] for part in sampled))
