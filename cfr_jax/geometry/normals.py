"""Normals from principal components of each point's neighborhood, with a consistent sign.

The direction in which the neighbors spread least is the surface normal (Hoppe et al., 1992). Its
sign is arbitrary, but it affects the network's features. So each normal is made to point away from
the cloud's centroid, which two partial views of one object roughly share and which moves with the
cloud.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32

from cfr_jax.geometry.eigen import least_direction
from cfr_jax.geometry.neighbors import others

# Neighbors are weighted by exp(-d^2 / 2 s^2), where s is this share of their root mean square
# distance. On noisy partial clouds of 717 points, 64 neighbors weighted this way give a median
# error of 18 degrees. Unweighted they give 21, and the 16 nearest alone give 20.
_REACH = 0.45


def estimate_normals(
    points: Float[Array, "n 3"],
    neighbors: Int32[Array, "n k"],
    mask: Bool[Array, " n"] | None = None,
) -> Float[Array, "n 3"]:
    """Unit normals of a cloud, from each point and its neighbors; zero for masked points.

    A neighborhood on a line has no unique normal: the result is some perpendicular direction, with
    zero gradient in the directions that are not determined.
    """
    offset = points[neighbors] - points[:, None]
    square = jnp.sum(offset * offset, axis=-1)
    k = neighbors.shape[1]
    columns = others(mask, k)
    if columns is None:
        reach = _REACH**2 * jnp.mean(square, axis=1, keepdims=True)
    else:
        counted = columns.astype(points.dtype)[None]
        total = jnp.sum(square * counted, axis=1, keepdims=True)
        reach = _REACH**2 * total / jnp.maximum(jnp.sum(counted), 1)
    weight = jnp.exp(square / jnp.where(reach > 0, -2 * reach, 1))
    weight = weight if columns is None else weight * counted
    # the point itself belongs to its neighborhood, with offset zero and weight one
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
