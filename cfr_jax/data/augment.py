"""What makes training pairs harder than their shapes: motion, orientation, scale, crop, density,
noise, outliers.

Every draw comes from the generator that is handed in. Lengths are in the unit sphere, where the
network works.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.spatial.transform import Rotation

from cfr_jax.data.protocol import NOISE_CLIP, NOISE_SCALE, random_motion, resample
from cfr_jax.geometry import motions
from cfr_jax.geometry.neighbors import nearest_on_host

_SHARES = (
    "both_ways",
    "near",
    "centered",
    "any_orientation",
    "uneven",
    "sensor_noise",
    "estimated_normals",
)
_RANGES = ("keep", "scale", "density", "outliers", "noise", "sensor_scale")
SENSOR_AWAY = (2.0, 4.0)  # of a sensor from the middle of what it sees


@dataclass(frozen=True)
class Sampling:
    """How training pairs are drawn. Pairs of numbers are ranges, from which each cloud (or, for
    `scale`, each pair) draws evenly; shares are of all pairs."""

    points: int = 717
    neighbors: int = 32
    radius: float = 0.3
    keep: tuple[float, float] = (0.7, 0.7)
    """Share of the shape left by the crop of each cloud."""
    angle: float = 45.0
    """Degrees; each Euler angle of the motion is drawn from [0, angle]."""
    translation: float = 0.5
    """Each coordinate of the motion is drawn from [-translation, translation]."""
    both_ways: float = 0.0
    """Share whose Euler angles are drawn from [-angle, angle] instead: the protocol's pairs are
    turned one way only, those of users any way."""
    near: float = 0.0
    """Share whose motion is smaller, by a factor drawn from [0, 1]: such is what a first cascade
    leaves to a second."""
    centered: float = 0.0
    """Share whose clouds lie about their own centroids, as `align` hands them over; the others
    about the middle of the shape, which a crop does not show."""
    any_orientation: float = 0.0
    """Share whose shape is first turned at random: CAD models stand upright, scans may not."""
    scale: tuple[float, float] = (1.0, 1.0)
    uneven: float = 0.0
    """Share whose clouds are denser on one side, each on a side of its own."""
    density: tuple[float, float] = (3.0, 10.0)
    """How many times denser the densest side then is than the sparsest."""
    outliers: tuple[float, float] = (0.0, 0.0)
    """Share of the points that lie anywhere in the ball around the cloud."""
    noise: tuple[float, float] = (NOISE_SCALE, NOISE_SCALE)
    """Standard deviation per axis, cut off at five times that."""
    sensor_noise: float = 0.0
    """Share whose noise is that of a depth sensor: along the ray, growing with distance squared."""
    sensor_scale: tuple[float, float] = (0.005, 0.02)
    """Its standard deviation at the middle of the cloud."""
    estimated_normals: float = 0.0
    """Share whose normals are estimated from the noisy points, as most users' are."""

    def __post_init__(self) -> None:
        for name in _SHARES:
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name}: got {getattr(self, name)}, wanted a share from 0 to 1")
        for name in _RANGES:
            given = getattr(self, name)
            if not (np.shape(given) == (2,) and 0 <= given[0] <= given[1]):
                raise ValueError(
                    f"{name}: got {given}, wanted two numbers from 0 on, the lower one first"
                )
        if not (self.angle >= 0 and self.translation >= 0):
            raise ValueError(
                f"angle, translation: got {self.angle} and {self.translation}, wanted 0 or more"
            )
        if self.points < 2:
            raise ValueError(f"points: got {self.points}, wanted at least 2")
        if not (self.keep[0] > 0 and self.keep[1] <= 1 and self.outliers[1] < 1):
            raise ValueError(
                f"keep, outliers: got {self.keep} and {self.outliers}, wanted shares of the points"
            )
        if not (self.scale[0] > 0 and self.density[0] >= 1):
            raise ValueError(
                f"scale, density: got {self.scale} and {self.density}, wanted more than 0 and "
                "at least 1"
            )
        if not 1 <= self.neighbors < self.points:
            raise ValueError(
                f"neighbors: got {self.neighbors} of {self.points} points, wanted fewer than those"
            )


@dataclass(frozen=True, eq=False)
class View:
    """One cloud of a pair before it is made harder: unit size, `sampling.points` rows."""

    points: Float32[np.ndarray, "n 3"]
    normals: Float32[np.ndarray, "n 3"] | None


def choose_rows(
    points: Float[np.ndarray, "p 3"], sampling: Sampling, uneven: bool, rng: np.random.Generator
) -> Int[np.ndarray, " n"]:
    """`sampling.points` rows of a cloud: at random, or thinning out along a random direction.

    None twice, unless there are too few.
    """
    if not uneven:
        return resample(len(points), sampling.points, rng)
    height = points @ _direction(rng)
    height = (height - height.min()) / max(float(np.ptp(height)), 1e-12)
    log_weight = np.log(rng.uniform(*sampling.density)) * height
    # the largest of weights perturbed by Gumbel noise are a weighted draw without replacement
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
    """A training pair as arrays: both clouds with their neighbors, and the true motion.

    `truth` maps the views onto each other, source onto target; what comes back as "transform" does
    so for the clouds as they come back, which are turned, scaled, moved and noisy.
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
    """The same on every axis, as the published protocols have it."""
    scale = rng.uniform(*sampling.noise)
    most = scale * NOISE_CLIP / NOISE_SCALE
    return points + np.clip(rng.normal(0.0, scale, points.shape), -most, most)


def add_sensor_noise(
    points: Float[np.ndarray, "n 3"], sampling: Sampling, rng: np.random.Generator
) -> Float[np.ndarray, "n 3"]:
    """Along the rays of a depth sensor somewhere around the cloud, which measures disparity: its
    error grows with the square of the distance (Khoshelham & Elberink, 2012)."""
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
    """Some points replaced by others, evenly spread in the ball that holds the cloud, with normals
    of any direction."""
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
