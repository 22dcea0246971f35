"""Normals by principal components of each point's neighborhood, with a consistent sign.

The direction of least spread of the neighbors is the normal of a surface (Hoppe et al., 1992). Its
sign is arbitrary, and the network's features feel it: each normal is turned away from the centroid
of the cloud, which two partial views of one object share roughly, and which moves with the cloud.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32

from cfr_jax.geometry.eigen import least_direction

# Neighbors count by exp(-d^2 / 2 s^2), s this share of their root mean square distance. On noisy
# partial clouds of 717 points 64 neighbors weighted so give a median error of 18 degrees, against
# 21 unweighted and 20 with the 16 nearest alone.
_REACH = 0.45


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
    square = jnp.sum(offset * offset, axis=-1)
    reach = _REACH**2 * jnp.mean(square, axis=1, keepdims=True)
    spread = reach > 0
    weight = jnp.exp(jnp.where(spread, square / jnp.where(spread, -2 * reach, 1), 0))
    # the point itself is part of its neighborhood, at offset zero and weight one
    weight = weight / (1 + jnp.sum(weight, axis=1, keepdims=True))
    mean = jnp.sum(weight[..., None] * offset, axis=1)
    covariance = jnp.einsum("nk,nki,nkj->nij", weight, offset, offset, precision="highest")
    covariance = covariance - mean[:, :, None] * mean[:, None, :]
    normals = jax.vmap(least_direction)(covariance)
    if mask is None:
        centroid = jnp.mean(points, axis=0)
    else:
        count = jnp.maximum(jnp.sum(mask, dtype=points.dtype), 1)
        centroid = jnp.sum(jnp.where(mask[:, None], points, 0), axis=0) / count
    outward = jnp.sum(normals * (points - centroid), axis=1, keepdims=True) >= 0
    normals = jnp.where(outward, normals, -normals)
    return normals if mask is None else jnp.where(mask[:, None], normals, 0)
