"""The closest point of a cloud to each query point, by comparing all pairs."""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float, Int32

_ENTRIES = 1 << 20  # ranks held at a time on a CPU, so that they stay in a core's cache


@struct.dataclass
class Closest:
    """For each query: the index of the closest point of a cloud, and its squared distance."""

    index: Int32[Array, " n"]
    square: Float[Array, " n"]


def closest(
    queries: Float[Array, "n 3"],
    points: Float[Array, "m 3"],
    mask: Bool[Array, " m"] | None = None,
) -> Closest:
    """The closest valid point to each query, by comparing all pairs.

    The clouds must be centered near zero. The gradient passes through the distance; the choice of
    the point is treated as constant.
    """
    index = lax.platform_dependent(
        *lax.stop_gradient((queries, points)),
        mask,
        cpu=_closest_by_product,
        default=_closest_by_differences,
    )
    offset = queries - points[index]
    return Closest(index, jnp.sum(offset * offset, axis=1))


def _closest_by_product(
    queries: Float[Array, "n 3"], points: Float[Array, "m 3"], mask: Bool[Array, " m"] | None
) -> Int32[Array, " n"]:
    """On a CPU, one matrix product ranks the points by |y|^2 - 2 x y.

    Cancellation can only confuse points whose distances agree up to float32's rounding.
    """
    norms = jnp.sum(points * points, axis=1)
    if mask is not None:
        norms = jnp.where(mask, norms, jnp.inf)
    m = points.shape[0]
    rows = max(1, min(queries.shape[0], _ENTRIES // m))
    blocks = -(-queries.shape[0] // rows)
    padded = jnp.pad(queries, ((0, blocks * rows - queries.shape[0]), (0, 0)))

    def block(here: Array) -> Array:
        rank = norms - 2 * jnp.matmul(here, points.T, precision=lax.Precision.HIGHEST)
        # two plain reductions, because XLA's argmin is not vectorized on CPUs
        best = jnp.min(rank, axis=1, keepdims=True)
        return jnp.min(jnp.where(rank <= best, jnp.arange(m, dtype=jnp.int32), m - 1), axis=1)

    return lax.map(block, padded.reshape(blocks, rows, 3)).reshape(-1)[: queries.shape[0]]


def _closest_by_differences(
    queries: Float[Array, "n 3"], points: Float[Array, "m 3"], mask: Bool[Array, " m"] | None
) -> Int32[Array, " n"]:
    """On an accelerator, one kernel computes and reduces the distances without storing them."""
    square = squares(queries[:, None], far_where_masked(points, mask))
    return lax.argmin(square, 1, jnp.int32)


def squares(
    queries: Float[Array, "... 3"], points: Float[Array, "... 3"]
) -> Float[Array, "*shape"]:
    """Squared distances from differences.

    The expansion |a|^2 - 2ab + |b|^2 would lose all digits for close points far from the origin.
    """
    x, y, z = ((queries[..., axis] - points[..., axis]) ** 2 for axis in range(3))
    return x + y + z


def far_where_masked(
    points: Float[Array, "n 3"], mask: Bool[Array, " n"] | None
) -> Float[Array, "n 3"]:
    """The points, with invalid ones moved to infinity, so that no search finds them."""
    return points if mask is None else jnp.where(mask[:, None], points, jnp.inf)
