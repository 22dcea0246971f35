"""RANSAC (Fischler & Bolles, 1981) over correspondences of FPFH, by Open3D."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from cfr_jax.evaluation.baselines.open3d_clouds import FeatureOptions
from cfr_jax.io import PointCloud
from cfr_jax.runtime.optional import require

_EDGES = 0.9  # lengths between the samples of a hypothesis agree to this share


def register(
    source: PointCloud,
    target: PointCloud,
    *,
    iterations: int = 50_000,
    **options: Any,
) -> Float[np.ndarray, "4 4"]:
    """The best of `iterations` hypotheses of three correspondences, inliers within `distance`.

    `options` are those of `FeatureOptions`. The same `seed` gives the same answer only on one
    thread: with more, threads race for the random numbers.
    """
    o3d = require("open3d")
    methods = o3d.pipelines.registration
    given = FeatureOptions(**options)
    source_cloud, source_features = given.described(source)
    target_cloud, target_features = given.described(target)
    o3d.utility.random.seed(given.seed)
    found = methods.registration_ransac_based_on_feature_matching(
        source_cloud,
        target_cloud,
        source_features,
        target_features,
        mutual_filter=True,
        max_correspondence_distance=given.distance,
        ransac_n=3,
        checkers=[
            methods.CorrespondenceCheckerBasedOnEdgeLength(_EDGES),
            methods.CorrespondenceCheckerBasedOnDistance(given.distance),
        ],
        criteria=methods.RANSACConvergenceCriteria(iterations, 0.999),
    )
    return np.array(found.transformation)
