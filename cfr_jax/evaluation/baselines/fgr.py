"""Fast global registration (Zhou, Park & Koltun, 2016) on FPFH, by Open3D."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from cfr_jax.evaluation.baselines.icp import descend
from cfr_jax.evaluation.baselines.open3d_clouds import FeatureOptions, open3d_cloud
from cfr_jax.io import PointCloud
from cfr_jax.runtime.optional import require


def register(
    source: PointCloud,
    target: PointCloud,
    *,
    iterations: int = 64,
    **options: Any,
) -> Float[np.ndarray, "4 4"]:
    """FGR with correspondences from FPFH, robust beyond `distance`.

    `options` are those of `FeatureOptions`; `seed` chooses the tuples tested.
    """
    o3d = require("open3d")
    methods = o3d.pipelines.registration
    given = FeatureOptions(**options)
    source_cloud, source_features = given.described(source)
    target_cloud, target_features = given.described(target)
    o3d.utility.random.seed(given.seed)
    found = methods.registration_fgr_based_on_feature_matching(
        source_cloud,
        target_cloud,
        source_features,
        target_features,
        methods.FastGlobalRegistrationOption(
            # the distance is in the clouds' unit, not a share of their extent
            use_absolute_scale=True,
            decrease_mu=True,
            maximum_correspondence_distance=given.distance,
            iteration_number=iterations,
        ),
    )
    return np.array(found.transformation)


def then_icp(
    source: PointCloud,
    target: PointCloud,
    *,
    distances: tuple[float, ...],
    normal_radius: float,
    **options: Any,
) -> Float[np.ndarray, "4 4"]:
    """FGR with these options, then point-to-plane ICP along `distances` on the full clouds."""
    methods = require("open3d").pipelines.registration
    coarse = register(source, target, normal_radius=normal_radius, **options)
    return descend(
        open3d_cloud(source),
        open3d_cloud(target, normal_radius),
        coarse,
        methods.TransformationEstimationPointToPlane(),
        distances,
        iterations=100,
    )
