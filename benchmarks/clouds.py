"""The pairs to time: the two views that ship with the package, at any number of points."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np

import cfr_jax as cfr
from cfr_jax import io

_NOISE = 0.002  # share of the radius; makes points differ if a point is drawn more than once


@functools.cache
def pair(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Source and target, (count, 3) float32 in the unit sphere; always the same for one count."""
    folder = Path(cfr.__file__).parent / "cli" / "demo_pair"
    rng = np.random.default_rng(count)
    clouds = []
    for name in ("source", "target"):
        points = io.read(folder / f"{name}.ply").points
        points = points[rng.choice(len(points), count, replace=len(points) < count)]
        points = points - points.mean(axis=0)
        points = points / np.linalg.norm(points, axis=1).max()
        points = points + _NOISE * rng.normal(size=points.shape)
        clouds.append(points.astype(np.float32))
    return clouds[0], clouds[1]
