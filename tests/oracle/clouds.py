"""Small synthetic pairs with exact normals and a known answer."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from . import pieces

Array = np.ndarray


class Pair(NamedTuple):
    """Two clouds, float32 like every caller's, and the transform (float64) of x onto y."""

    x: Float[Array, "n 3"]
    y: Float[Array, "m 3"]
    nx: Float[Array, "n 3"]
    ny: Float[Array, "m 3"]
    transform: Float[Array, "4 4"]


def random_pair(seed: int, n: int, m: int, *, angle: float = 30.0) -> Pair:
    """Two samplings of one bumpy closed surface, the source moved out of its place.

    `angle` (degrees) is the size of the true rotation; its axis and a shift within 0.3 are random.
    The samplings are independent, so no point of one is exactly a point of the other. The
    reference lies in the unit sphere, and most of it within 0.8.
    """
    rng = np.random.default_rng(seed)
    waves = rng.normal(size=(4, 3)) * 1.5
    heights = 0.12 * rng.uniform(0.5, 1, size=4)
    phases = rng.uniform(0, 2 * np.pi, size=4)
    axis = rng.normal(size=3)
    rotation = Rotation.from_rotvec(np.radians(angle) * axis / np.linalg.norm(axis)).as_matrix()
    transform = pieces.rigid(rotation, rng.uniform(-0.3, 0.3, size=3))

    y, ny = _sample(rng, m, waves, heights, phases)
    x, nx = _sample(rng, n, waves, heights, phases)
    x, nx = pieces.move(np.linalg.inv(transform), x), nx @ rotation  # rows: R^T n
    x, y, nx, ny = (array.astype(np.float32) for array in (x, y, nx, ny))
    return Pair(x, y, nx, ny, transform)


def _sample(
    rng: np.random.Generator, count: int, waves: Array, heights: Array, phases: Array
) -> tuple[Array, Array]:
    """Points r(u) u for unit directions u, r(u) = 0.5 + sum of waves, with outward normals."""
    u = rng.normal(size=(count, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    radius = 0.5 + np.sin(u @ waves.T + phases) @ heights
    slope = (np.cos(u @ waves.T + phases) * heights) @ waves
    tangential = slope - (slope * u).sum(axis=1, keepdims=True) * u
    normals = radius[:, None] * u - tangential  # gradient of |p| - r(p/|p|), times r
    return radius[:, None] * u, normals / np.linalg.norm(normals, axis=1, keepdims=True)
