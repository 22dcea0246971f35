"""Training pairs drawn on the host: motion, orientation, scale, density, noise, outliers.

Every random number comes from the generator that is passed in. Lengths refer to the unit sphere, in
which the network works.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.spatial.transform import Rotation

from cfr_jax.data.augmentation.sampling import SENSOR_AWAY, Sampling
from cfr_jax.data.perturbations import NOISE_CLIP, NOISE_SCALE, random_motion, resample
from cfr_jax.geometry import motions
from cfr_jax.geometry.neighbors import nearest_on_host


@dataclass(frozen=True, eq=False)
class View:
    """One cloud of a pair before augmentation: of unit size, with `sampling.points` rows."""

    points: Float32[np.ndarray, "n 3"]
    normals: Float32[np.ndarray, "n 3"] | None


def choose_rows(
    points: Float[np.ndarray, "p 3"], sampling: Sampling, uneven: bool, rng: np.random.Generator
) -> Int[np.ndarray, " n"]:
    """`sampling.points` random rows of a cloud.

    If `uneven`, the cloud gets sparser along a random direction. No row is chosen twice, unless
    there are too few.
    """
    if not uneven:
        return resample(len(points), sampling.points, rng)
    height = points @ _direction(rng)
    height = (height - height.min()) / max(float(np.ptp(height)), 1e-12)
    log_weight = np.log(rng.uniform(*sampling.density)) * height
    # Gumbel noise on the log weights: the largest sums are a weighted draw without replacement.
    order = np.argsort(-(log_weight + rng.gumbel(size=len(points))))
    chosen = order[: sampling.points]
    return np.concatenate([chosen, chosen[resample(len(chosen), sampling.points, rng)]])[
        : sampling.points
    ]


def finish_pair(
    source: View,
    target: View,
    truth: Float[np.ndarray, "4 4"],
    sampling: Sampling,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """A training pair as a dict of arrays: both clouds with their neighbors, and the true motion.

    `truth` maps the source view onto the target view. The returned "transform" maps the returned
    source onto the returned target, after they were rotated, scaled, moved and made noisy.
    """
    turn = np.eye(3)
    if rng.random() < sampling.any_orientation:
        turn = Rotation.random(random_state=rng).as_matrix()
    scale = rng.uniform(*sampling.scale)
    motion = _motion(sampling, rng)
    centered = rng.random() < sampling.centered
    sensor = rng.random() < sampling.sensor_noise
    estimate = rng.random() < sampling.estimated_normals
    turned = np.eye(4)
    turned[:3, :3] = turn @ truth[:3, :3] @ turn.T
    turned[:3, 3] = scale * (turn @ truth[:3, 3])
    pair: dict[str, Any] = {
        "estimate_normals": estimate or source.normals is None or target.normals is None
    }
    moved = {}
    for side, view, placed in (("source", source, motion), ("target", target, np.eye(4))):
        rotation = placed[:3, :3] @ turn
        points = scale * (view.points @ rotation.T) + placed[:3, 3]
        normals = np.zeros_like(points) if view.normals is None else view.normals @ rotation.T
        points = (add_sensor_noise if sensor else add_noise)(points, sampling, rng)
        points, normals = add_outliers(points, normals, sampling, rng)
        middle = centered * points.mean(axis=0)
        moved[side] = np.eye(4)
        moved[side][:3, 3] = -middle
        points = (points - middle).astype(np.float32)
        pair[side] = points
        pair[f"{side}_normals"] = normals.astype(np.float32)
        pair[f"{side}_neighbors"] = nearest_on_host(
            points, sampling.neighbors, radius=sampling.radius
        )
    truth = moved["target"] @ turned @ motions.inverse(motion) @ np.linalg.inv(moved["source"])
    return pair | {"transform": truth.astype(np.float32)}


def _motion(sampling: Sampling, rng: np.random.Generator) -> Float[np.ndarray, "4 4"]:
    both_ways = rng.random() < sampling.both_ways
    factor = rng.random() if rng.random() < sampling.near else 1.0
    reach = factor * sampling.angle, factor * sampling.translation
    return random_motion(*reach, rng, both_ways=both_ways)


def add_noise(
    points: Float[np.ndarray, "n 3"], sampling: Sampling, rng: np.random.Generator
) -> Float[np.ndarray, "n 3"]:
    """Adds Gaussian noise of equal scale on every axis, as in the published protocols."""
    scale = rng.uniform(*sampling.noise)
    most = scale * NOISE_CLIP / NOISE_SCALE
    return points + np.clip(rng.normal(0.0, scale, points.shape), -most, most)


def add_sensor_noise(
    points: Float[np.ndarray, "n 3"], sampling: Sampling, rng: np.random.Generator
) -> Float[np.ndarray, "n 3"]:
    """Adds noise along the rays of a depth sensor at a random place around the cloud.

    Such a sensor measures disparity, so its error grows with the square of the distance
    (Khoshelham & Elberink, 2012).
    """
    middle = points.mean(axis=0)
    away = rng.uniform(*SENSOR_AWAY)
    ray = points - (middle + away * _direction(rng))
    distance = np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-6)
    scale = rng.uniform(*sampling.sensor_scale) * (distance / away) ** 2
    error = np.clip(rng.normal(size=distance.shape), -5, 5) * scale
    return points + ray / distance * error


def add_outliers(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    sampling: Sampling,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Replaces some points by points spread evenly in the ball around the cloud, with random
    normals."""
    count = int(rng.uniform(*sampling.outliers) * len(points))
    if not count:
        return points, normals
    rows = rng.choice(len(points), count, replace=False)
    middle = points.mean(axis=0)
    reach = np.linalg.norm(points - middle, axis=1).max()
    radius = reach * rng.random((count, 1)) ** (1 / 3)
    points, normals = points.copy(), normals.copy()
    points[rows] = middle + radius * np.stack([_direction(rng) for _ in rows])
    normals[rows] = np.stack([_direction(rng) for _ in rows])
    return points, normals


def _direction(rng: np.random.Generator) -> Float[np.ndarray, " 3"]:
    direction = rng.normal(size=3)
    return direction / np.linalg.norm(direction)
