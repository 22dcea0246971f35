"""The raw channels of a point and its neighbors, which the learned layers start from.

The point-pair feature (Drost et al., 2010) describes a point p with normal n and a neighbor q with
normal m. With d = q - p, it holds how d relates to each normal, how the normals relate to each
other, and |d|. It does not change under rigid motions. There are two forms: "dot" (CFR) takes inner
products of unit vectors, "angle" (RPM-Net) takes their angles.
"""

from __future__ import annotations

from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float, Int32

PairFeature = Literal["dot", "angle"]


def raw_features(
    points: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    neighbors: Int32[Array, "n k"],
    *,
    ppf: PairFeature = "dot",
    position: bool = False,
) -> Float[Array, "n k c"]:
    """Seven channels: the offset to the neighbor (3), then the point-pair feature (4).

    With `position`, the point's own coordinates come first: ten channels in all, as in RPM-Net.
    """
    offset = points[neighbors] - points[:, None]
    channels = [offset, pair_feature(offset, normals[:, None], normals[neighbors], ppf=ppf)]
    if position:
        channels.insert(0, jnp.broadcast_to(points[:, None], offset.shape))
    return jnp.concatenate(channels, axis=-1)


def pair_feature(
    offset: Float[Array, "n k 3"],
    normals: Float[Array, "n 1 3"],
    neighbor_normals: Float[Array, "n k 3"],
    *,
    ppf: PairFeature,
) -> Float[Array, "n k 4"]:
    """Channels (n, d), (m, d), (n, m), |d|, where (a, b) is a dot product or an angle in radians.

    Gradients are finite everywhere: where d or a cross product is zero, zero is used instead.
    Raises ValueError for an unknown form.
    """
    length = safe_norm(offset)
    if ppf == "dot":
        direction = offset / (length + 1e-6)[..., None]
        relate = _dot
    elif ppf == "angle":
        direction = offset
        relate = _angle
    else:
        raise ValueError(f"ppf: got {ppf!r}, wanted 'dot' or 'angle'")
    return jnp.stack(
        [
            relate(normals, direction),
            relate(neighbor_normals, direction),
            relate(normals, neighbor_normals),
            length,
        ],
        axis=-1,
    )


def safe_norm(vectors: Float[Array, "*rows c"]) -> Float[Array, "*rows"]:
    """Euclidean length along the last axis; at zero the gradient is zero instead of NaN."""
    square = jnp.sum(vectors * vectors, axis=-1)
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1)), 0)


def _dot(a: Array, b: Array) -> Array:
    # written out: a matrix product would run at reduced precision on accelerators
    return jnp.sum(a * b, axis=-1)


def _angle(a: Array, b: Array) -> Array:
    sine, cosine = safe_norm(jnp.cross(a, b)), _dot(a, b)
    nowhere = (sine == 0) & (cosine == 0)
    return jnp.where(nowhere, 0, jnp.arctan2(sine, jnp.where(nowhere, 1, cosine)))
