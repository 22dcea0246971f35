"""Generalized ICP (Segal, Haehnel & Thrun, 2009) from the library small_gicp (Koide, 2024)."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from jaxtyping import Float

from cfr_jax.refine import generalized_icp
from cfr_jax.refine.surfaces import Fit, HostSurface
from cfr_jax.runtime.optional import require

_CUTS = tuple(stage.cut for stage in generalized_icp.STAGES)


def refine(
    source: HostSurface,
    target: HostSurface,
    initial: Float[np.ndarray, "4 4"],
    *,
    distances: tuple[float, ...] = _CUTS,
    neighbors: int = 20,
    iterations: int = 100,
) -> Fit:
    """Runs GICP from `initial`, which maps source onto target, once for each of `distances`, with
    at most `iterations` each.

    Pairs further apart than the distance are rejected. The covariance of a point comes from its
    `neighbors` nearest points; normals are not used. This function does not check whether the
    result is better than `initial`.
    """
    small_gicp = require("small_gicp")
    (moving, _), (cloud, tree) = (
        surface.once(
            ("small_gicp", neighbors), functools.partial(_prepared, surface.points, neighbors)
        )
        for surface in (source, target)
    )
    motion, converged, steps = initial, False, 0
    for distance in distances:
        # small_gicp's default tolerances suit LiDAR on a car: 0.1 degrees and a millimeter
        found = small_gicp.align(
            cloud,
            moving,
            tree,
            init_T_target_source=motion,
            registration_type="GICP",
            max_correspondence_distance=distance,
            max_iterations=iterations,
            rotation_epsilon=1e-5,
            translation_epsilon=1e-5 * distance,
        )
        motion, converged = np.array(found.T_target_source), bool(found.converged)
        steps += int(found.iterations)
    return Fit(np.array(motion), True, converged, steps)


def _prepared(points: Float[np.ndarray, "n 3"], neighbors: int) -> tuple[Any, Any]:
    """The library's cloud with covariances, and its KD-tree."""
    small_gicp = require("small_gicp")
    cloud = small_gicp.PointCloud(points)
    tree = small_gicp.KdTree(cloud)
    small_gicp.estimate_covariances(cloud, tree, num_neighbors=neighbors)
    return cloud, tree
