"""Normals by principal components of each point's neighborhood, with a consistent sign.

The direction of least spread of the neighbors is the normal of a surface (Hoppe et al., 1992). Its
sign is arbitrary, and the network's features feel it: each normal is turned away from the centroid of
the cloud, which two partial views of one object share roughly, and which moves with the cloud.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32

from cfr_jax.eigen import least_direction


def estimate_normals(
    points: Float[Array, "n 3"],
    neighbors: Int32[Array, "n k"],
    mask: Bool[Array, " n"] | None = None,
) -> Float[Array, "n 3"]:
    """Unit normals of a cloud from each point and its neighbors; zero where masked.

    A neighborhood on a line has no normal of its own: any perpendicular direction is given, with
    zero gradient in what is not determined.
    """
    offset = points[neighbors] - points[:, None]
    # the point itself is part of its neighborhood: it adds nothing to the sum, but counts
    offset = offset - jnp.sum(offset, axis=1, keepdims=True) / (neighbors.shape[1] + 1)
    covariance = jnp.einsum("nki,nkj->nij", offset, offset, precision="highest")
    normals = jax.vmap(least_direction)(covariance)
    if mask is None:
        centroid = jnp.mean(points, axis=0)
    else:
        centroid = jnp.sum(jnp.where(mask[:, None], points, 0), axis=0) / jnp.maximum(mask.sum(), 1)
    outward = jnp.sum(normals * (points - centroid), axis=1, keepdims=True) >= 0
    normals = jnp.where(outward, normals, -normals)
    return normals if mask is None else jnp.where(mask[:, None], normals, 0)
