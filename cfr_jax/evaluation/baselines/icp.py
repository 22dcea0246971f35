"""Iterative closest point (Besl & McKay, 1992; Chen & Medioni, 1991), by Open3D."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from cfr_jax.evaluation.baselines.open3d_clouds import open3d_cloud
from cfr_jax.evaluation.baselines.start import Start, initial
from cfr_jax.io import PointCloud
from cfr_jax.runtime.optional import require


def point_to_point(
    source: PointCloud,
    target: PointCloud,
    *,
    distances: tuple[float, ...],
    start: Start = "centroid",
    iterations: int = 100,
) -> Float[np.ndarray, "4 4"]:
    """ICP with a rejection distance that shrinks along `distances`; `iterations` for each."""
    methods = require("open3d").pipelines.registration
    return descend(
        open3d_cloud(source),
        open3d_cloud(target),
        initial(source, target, start),
        methods.TransformationEstimationPointToPoint(),
        distances,
        iterations,
    )


def point_to_plane(
    source: PointCloud,
    target: PointCloud,
    *,
    distances: tuple[float, ...],
    normal_radius: float,
    start: Start = "centroid",
    iterations: int = 100,
) -> Float[np.ndarray, "4 4"]:
    """The same, to the tangent planes of the target; missing normals are estimated."""
    methods = require("open3d").pipelines.registration
    return descend(
        open3d_cloud(source),
        open3d_cloud(target, normal_radius),
        initial(source, target, start),
        methods.TransformationEstimationPointToPlane(),
        distances,
        iterations,
    )


def descend(
    source: Any,
    target: Any,
    motion: Float[np.ndarray, "4 4"],
    estimation: Any,
    distances: tuple[float, ...],
    iterations: int,
) -> Float[np.ndarray, "4 4"]:
    """ICP on Open3D clouds, starting from `motion`, with one stage per distance."""
    methods = require("open3d").pipelines.registration
    criteria = methods.ICPConvergenceCriteria(max_iteration=iterations)
    for distance in distances:
        motion = methods.registration_icp(
            source, target, distance, motion, estimation, criteria
        ).transformation
    return np.array(motion)
