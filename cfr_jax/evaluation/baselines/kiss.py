"""KISS-Matcher (Lim et al., 2025): faster FPFH, k-core pruning, graduated non-convexity."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from cfr_jax.evaluation.baselines import NoMotion
from cfr_jax.io import PointCloud
from cfr_jax.runtime.optional import require


def register(
    source: PointCloud,
    target: PointCloud,
    *,
    voxel: float,
    thin: bool = True,
    normal_gain: float = 3.0,
    feature_gain: float = 5.0,
) -> Float[np.ndarray, "4 4"]:
    """KISS-Matcher; all of its lengths follow from `voxel`. With `thin`, it thins to `voxel` first.

    The gains are the radii of normals and features, in voxels. It does not use given normals.
    """
    kiss_matcher = require("kiss_matcher")
    config = kiss_matcher.KISSMatcherConfig(
        voxel_size=voxel,
        use_voxel_sampling=thin,
        normal_r_gain=normal_gain,
        fpfh_r_gain=feature_gain,
    )
    found = kiss_matcher.KISSMatcher(config).estimate(
        source.points.astype(np.float32), target.points.astype(np.float32)
    )
    if not found.valid:
        raise NoMotion("KISS-Matcher reports that its solution is not valid")
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = found.rotation, found.translation
    return motion
