"""What is done to a shape to make a pair of it: crops, a motion, a draw of points, noise.

All random numbers come from the generator that is passed in, numpy's legacy `RandomState` or a
`Generator`, in a fixed order: published test sets (`data.protocol`) are repeated draw by draw.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, Int

from cfr_jax.geometry import motions

Rng = np.random.RandomState | np.random.Generator

NOISE_SCALE = 0.01
NOISE_CLIP = 0.05


def crop(points: Float[np.ndarray, "p 3"], keep: float, rng: Rng) -> Int[np.ndarray, " kept"]:
    """Rows that a crop keeps: those beyond a plane with a random normal, a share of `keep`.

    For exactly one half the plane goes through the mean, as in the published low-overlap sets, so
    the share is only roughly one half. Raises ValueError if no point is left.
    """
    height = (points - points.mean(axis=0)) @ _direction(rng)
    # The published share is a float32, so in float64 (1 - 0.7) * 100 is not quite 30.
    percentile = (1.0 - float(np.float32(keep))) * 100
    plane = 0.0 if keep == 0.5 else np.percentile(height, percentile)
    kept = np.flatnonzero(height > plane)
    if not len(kept):
        raise ValueError(
            f"points: a crop to {keep} leaves none of {len(points)} points, wanted a cloud whose "
            "points do not coincide"
        )
    return kept


def opposite_sides(
    points: Float[np.ndarray, "p 3"], overlap: float, rng: Rng
) -> tuple[Int[np.ndarray, " kept"], Int[np.ndarray, " kept"]]:
    """Rows of two crops from the two ends of one random direction, which share `overlap` of each.

    Each keeps 1 / (2 - overlap) of the points, so that together they are the whole shape.
    """
    order = np.argsort(points @ _direction(rng), kind="stable")
    kept = round(len(points) / (2 - overlap))
    return np.sort(order[:kept]), np.sort(order[len(points) - kept :])


def _direction(rng: Rng) -> Float[np.ndarray, " 3"]:
    azimuth = rng.uniform(0.0, 2 * np.pi)
    polar = np.arccos(rng.uniform(-1.0, 1.0))
    return np.array(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]
    )


def random_motion(
    angle: float | None, translation: float, rng: Rng, *, both_ways: bool = False
) -> Float32[np.ndarray, "4 4"]:
    """R = Rx Ry Rz with each angle in [0, angle] degrees, then a translation within a cube.

    `both_ways` draws the angles from [-angle, angle]. If `angle` is None, the rotation is uniform
    over SO(3), from a random unit quaternion. Each coordinate of the translation is in
    [-translation, translation].
    """
    motion = np.eye(4)
    if angle is None:
        motion[:3, :3] = motions.from_xyzw(rng.normal(size=4))
    else:
        x, y, z = (rng.uniform() * np.pi * angle / 180.0 for _ in range(3))
        if both_ways:
            x, y, z = (2 * drawn - np.pi * angle / 180.0 for drawn in (x, y, z))
        about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
        about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
        about_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
        motion[:3, :3] = about_x @ about_y @ about_z
    motion[:3, 3] = rng.uniform(-translation, translation, 3)
    return motion.astype(np.float32)


def resample(size: int, count: int, rng: Rng) -> Int[np.ndarray, " count"]:
    """`count` of `size` rows, without repeats; if there are too few, all of them plus repeats."""
    if count <= size:
        return rng.choice(size, count, replace=False)
    return np.concatenate(
        [rng.choice(size, size, replace=False), rng.choice(size, count - size, replace=True)]
    )


def jitter(points: Float32[np.ndarray, "n 3"], rng: Rng) -> Float32[np.ndarray, "n 3"]:
    """Points with clipped Gaussian noise. All protocols leave the normals exact."""
    drawn = rng.normal(0.0, NOISE_SCALE, points.shape)
    return (points + np.clip(drawn, -NOISE_CLIP, NOISE_CLIP)).astype(np.float32)
