"""How training pairs are drawn: the options of all augmentations.

Lengths refer to the unit sphere, in which the network works.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cfr_jax.data.perturbations import NOISE_SCALE

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
SENSOR_AWAY = (2.0, 4.0)  # distance of a simulated sensor from the center of the cloud


@dataclass(frozen=True)
class Sampling:
    """How training pairs are drawn.

    A pair of numbers is a range, from which each cloud draws uniformly (for `scale`: each pair).
    Shares are shares of all pairs.
    """

    points: int = 717
    neighbors: int = 32
    radius: float = 0.3
    keep: tuple[float, float] = (0.7, 0.7)
    """Share of the shape that the crop of each cloud keeps."""
    angle: float = 45.0
    """Degrees; each Euler angle of the motion is drawn from [0, angle]."""
    translation: float = 0.5
    """Each coordinate of the motion is drawn from [-translation, translation]."""
    both_ways: float = 0.0
    """Share whose Euler angles are drawn from [-angle, angle] instead. The protocol turns its pairs
    in one direction only, but users' pairs may be turned either way."""
    near: float = 0.0
    """Share whose motion is scaled down by a factor drawn from [0, 1]. A first cascade leaves such
    small motions to a second one."""
    centered: float = 0.0
    """Share whose clouds are centered at their own centroids, as in `align`. The others are
    centered at the middle of the shape, which a crop does not reveal."""
    any_orientation: float = 0.0
    """Share whose shape is first rotated at random. CAD models stand upright, but scans may not."""
    scale: tuple[float, float] = (1.0, 1.0)
    """Factor by which both clouds are scaled."""
    uneven: float = 0.0
    """Share whose clouds are denser on one side, a different side for each cloud."""
    density: tuple[float, float] = (3.0, 10.0)
    """How many times denser the densest side of such a cloud is than its sparsest side."""
    outliers: tuple[float, float] = (0.0, 0.0)
    """Share of points that are replaced by points anywhere in the ball around the cloud."""
    noise: tuple[float, float] = (NOISE_SCALE, NOISE_SCALE)
    """Standard deviation per axis. Noise is clipped at five standard deviations."""
    sensor_noise: float = 0.0
    """Share with the noise of a depth sensor: along the ray, growing with the squared distance."""
    sensor_scale: tuple[float, float] = (0.005, 0.02)
    """Standard deviation of the sensor noise at the center of the cloud."""
    estimated_normals: float = 0.0
    """Share whose normals are estimated from the noisy points, as for most users' clouds."""
    copied: bool = False
    """Whether both clouds are made of the same points of the shape, before crop and noise, as some
    published trainings have it. That a point of one cloud lies exactly on one of the other is what
    they then learn, and what no two scans have."""

    def __post_init__(self) -> None:
        for name in _SHARES:
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name}: got {getattr(self, name)}, wanted a share from 0 to 1")
        for name in _RANGES:
            given = getattr(self, name)
            if not (np.shape(given) == (2,) and 0 <= given[0] <= given[1]):
                raise ValueError(
                    f"{name}: got {given}, wanted two numbers >= 0, the lower one first"
                )
        if not (self.angle >= 0 and self.translation >= 0):
            raise ValueError(
                f"angle, translation: got {self.angle} and {self.translation}, wanted 0 or more"
            )
        if self.points < 2:
            raise ValueError(f"points: got {self.points}, wanted at least 2")
        if not (self.keep[0] > 0 and self.keep[1] <= 1 and self.outliers[1] < 1):
            raise ValueError(
                f"keep, outliers: got {self.keep} and {self.outliers}, wanted shares of the "
                "points: keep above 0 and at most 1, outliers below 1"
            )
        if not (self.scale[0] > 0 and self.density[0] >= 1):
            raise ValueError(
                f"scale, density: got {self.scale} and {self.density}, wanted a scale above 0 "
                "and a density of at least 1"
            )
        if not 1 <= self.neighbors < self.points:
            raise ValueError(
                f"neighbors: got {self.neighbors}, wanted at least 1 and fewer than the "
                f"{self.points} points"
            )


def shared_count(sampling: Sampling, count: int) -> int:
    """Of how many of a shape's `count` points both clouds are made, where they are copied: as many
    as the deepest crop then leaves `sampling.points` of."""
    return min(count, math.ceil(sampling.points / np.float32(sampling.keep[0])))
