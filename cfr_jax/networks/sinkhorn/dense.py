"""The match with its block of affinities stored, in scaling form.

The normalized block is diag(u) m diag(v), where u <- 1 / (m v + 1) and v <- 1 / (m' u + 1),
starting from v = 1. These are matrix-vector products only: the block is read and never rewritten
("log-free", Hisadome & Matsui, 2021; scaling form after Cuturi, 2013).
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from cfr_jax.networks.sinkhorn.affinity import Affinity, Match, masked, match_of, with_ones

_HIGHEST = lax.Precision.HIGHEST


def match_dense(
    affinity: Affinity,
    points: Float[Array, "m 3"],
    *,
    passes: int,
    source_mask: Bool[Array, " n"] | None = None,
    target_mask: Bool[Array, " m"] | None = None,
) -> Match:
    """`match` with the (n, m) block stored.

    Each row is shifted by r = max(0, its largest entry), so that no exponential overflows; its
    scaling is kept as u e^r.
    """
    log_values = masked(affinity.log(), source_mask, target_mask)
    # the result does not depend on the shift, so it needs no gradient
    shift = lax.stop_gradient(jnp.maximum(jnp.max(log_values, axis=1), 0))
    block = jnp.exp(log_values - shift[:, None])
    slack = jnp.exp(-shift)
    tiny = jnp.finfo(block.dtype).tiny
    v = jnp.ones(block.shape[1], block.dtype)
    # With the barrier, an accelerator makes the block and the sums of its rows in one kernel.
    # Without it, XLA stores the logarithms as well, and computes the block from them repeatedly.
    block, found = lax.optimization_barrier((block, jnp.matmul(block, v, precision=_HIGHEST)))
    for i in range(passes):
        if i:
            found = jnp.matmul(block, v, precision=_HIGHEST)
        # the floor is reached only if a whole row underflows: that point stays without a partner
        u = 1 / jnp.maximum(found + slack, tiny)
        found = jnp.matmul(u, block, precision=_HIGHEST)
        v = 1 / (found + 1)
    sums = jnp.matmul(block, v[:, None] * with_ones(points), precision=_HIGHEST)
    return match_of(u[:, None] * sums, v * found)
