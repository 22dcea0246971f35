"""RANSAC (Fischler & Bolles, 1981) on FPFH correspondences, by Open3D."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from cfr_jax.evaluation.baselines.open3d_clouds import described
from cfr_jax.io import PointCloud
from cfr_jax.runtime.optional import require

_EDGES = 0.9  # least ratio of the lengths between the samples of a hypothesis


def register(
    source: PointCloud,
    target: PointCloud,
    *,
    distance: float,
    normal_radius: float,
    feature_radius: float,
    voxel: float | None = None,
    iterations: int = 50_000,
    seed: int = 0,
) -> Float[np.ndarray, "4 4"]:
    """The best of `iterations` hypotheses of three correspondences, inliers within `distance`.

    If `voxel` is given, the clouds are thinned to it first. The same `seed` gives the same answer
    only on one thread: several threads race for the random numbers.
    """
    o3d = require("open3d")
    methods = o3d.pipelines.registration
    made = [described(c, normal_radius, feature_radius, voxel) for c in (source, target)]
    (source_cloud, source_features), (target_cloud, target_features) = made
    o3d.utility.random.seed(seed)
    found = methods.registration_ransac_based_on_feature_matching(
        source_cloud,
        target_cloud,
        source_features,
        target_features,
        mutual_filter=True,
        max_correspondence_distance=distance,
        ransac_n=3,
        checkers=[
            methods.CorrespondenceCheckerBasedOnEdgeLength(_EDGES),
            methods.CorrespondenceCheckerBasedOnDistance(distance),
        ],
        criteria=methods.RANSACConvergenceCriteria(iterations, 0.999),
    )
    return np.array(found.transformation)
