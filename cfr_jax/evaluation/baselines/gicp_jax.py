"""Our own refinement (`cfr_jax.refine.generalized_icp`), without a network before it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfr_jax import refine
from cfr_jax.data.scans import estimate_normals
from cfr_jax.evaluation.baselines.start import Start, initial
from cfr_jax.geometry import motions
from cfr_jax.io import PointCloud
from cfr_jax.refine.generalized_icp import CUT
from cfr_jax.refine.surfaces import Surface


def register(
    source: PointCloud,
    target: PointCloud,
    *,
    cut: float,
    normal_radius: float,
    start: Start = "centroid",
) -> Float[np.ndarray, "4 4"]:
    """Generalized ICP whose robust cut shrinks over 4, 2 and 1 times `cut`.

    The clouds are scaled so that `cut` becomes the refinement's usual last cut. Missing normals are
    estimated.
    """
    motion = initial(source, target, start)
    center, scale = target.points.mean(axis=0), cut / CUT
    moved = motions.apply(motion, source.points)
    found = _refine(
        *(jnp.asarray((points - center) / scale, jnp.float32) for points in (moved, target.points)),
        *(jnp.asarray(_normals(cloud, normal_radius), jnp.float32) for cloud in (source, target)),
    )
    unit = np.asarray(found, np.float64)
    # x = center + scale * u on both sides
    shift = center + scale * unit[:3, 3] - unit[:3, :3] @ center
    return motions.motion(unit[:3, :3], shift) @ motion


@jax.jit
def _refine(
    source: Float[Array, "n 3"],
    target: Float[Array, "m 3"],
    source_normals: Float[Array, "n 3"],
    target_normals: Float[Array, "m 3"],
) -> Float[Array, "4 4"]:
    moving, fixed = (
        Surface(points, normals, jnp.ones(len(points), bool))
        for points, normals in ((source, source_normals), (target, target_normals))
    )
    return jnp.asarray(refine.named(refine.DEFAULT)(moving, fixed, jnp.eye(4)).transform)


def _normals(cloud: PointCloud, radius: float) -> Float[np.ndarray, "n 3"]:
    if cloud.normals is not None:
        return cloud.normals
    return estimate_normals(cloud.points, radius)
