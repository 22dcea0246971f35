"""Generalized ICP (Segal, Haehnel & Thrun, 2009), by the library small_gicp (Koide, 2024)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from cfr_jax.runtime.optional import require


class Descent(NamedTuple):
    """Where it ended, whether the last stage settled there, and how many steps all took."""

    motion: Float[np.ndarray, "4 4"]
    converged: bool
    steps: int


def descend(
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "m 3"],
    motion: Float[np.ndarray, "4 4"],
    distances: tuple[float, ...],
    neighbors: int = 20,
    iterations: int = 100,
) -> Descent:
    """GICP from `motion`, which maps source onto target."""
    small_gicp = require("small_gicp")
    clouds, trees = zip(
        *(_with_covariances(points, neighbors) for points in (source, target)), strict=True
    )
    converged, steps = False, 0
    for distance in distances:
        # small_gicp's usual tolerances are those of a car: 0.1 degrees and a millimeter
        found = small_gicp.align(
            clouds[1],
            clouds[0],
            trees[1],
            init_T_target_source=motion,
            registration_type="GICP",
            max_correspondence_distance=distance,
            max_iterations=iterations,
            rotation_epsilon=1e-5,
            translation_epsilon=1e-5 * distance,
        )
        motion, converged = np.array(found.T_target_source), bool(found.converged)
        steps += int(found.iterations)
    return Descent(np.array(motion), converged, steps)


def _with_covariances(points: Float[np.ndarray, "n 3"], neighbors: int) -> tuple[Any, Any]:
    small_gicp = require("small_gicp")
    cloud = small_gicp.PointCloud(points)
    tree = small_gicp.KdTree(cloud)
    small_gicp.estimate_covariances(cloud, tree, num_neighbors=neighbors)
    return cloud, tree
