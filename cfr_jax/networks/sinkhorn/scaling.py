"""The match and its gradient by products with a block that is stored in memory.

Forward, a pass is u <- 1 / (m v + 1), v <- 1 / (m' u + 1). The gradient takes the same steps
backward (see `streamed`). In the end the gradient with respect to log m_ij is m_ij times a product
of two thin matrices, and `Stored.spend` carries it on to the features.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from cfr_jax.networks.sinkhorn.affinity import (
    Affinity,
    Match,
    Trace,
    gradient_of_scaling,
    gradient_of_sums,
    log_affinity,
    masked,
    match_of,
    squared_distances,
    with_ones,
)

_HIGHEST = lax.Precision.HIGHEST


class Spent(NamedTuple):
    """Sums of share_ij over a block.

    In the order of the fields: times g_j, times f_i, times alpha - |f_i - g_j|^2, and as it is.
    """

    source: Float[Array, "n d"]
    target: Float[Array, "m d"]
    beta: Float[Array, ""]
    alpha: Float[Array, ""]


def forward(block: Stored, points: Float[Array, "m 3"], passes: int) -> tuple[Match, Trace]:
    """The match, and what its gradient needs."""
    tiny = jnp.finfo(points.dtype).tiny
    slack = jnp.exp(-block.shift)
    v, every = jnp.ones(points.shape[0], points.dtype), []
    for i in range(passes):
        found = block.rows(v[:, None])[:, 0] if i else block.sums
        # the floor is reached only if a whole row underflows: that point stays without a partner
        u = 1 / jnp.maximum(found + slack, tiny)
        found = block.columns(u[:, None])[:, 0]
        every.append((u, v))
        v = 1 / (found + 1)
    sums = u[:, None] * block.rows(v[:, None] * with_ones(points))
    u_of_all, v_before = (jnp.stack(part) for part in zip(*every, strict=True))
    return match_of(sums, v * found), Trace(u_of_all, v_before, v, block.shift, sums)


def backward(
    block: Stored, affinity: Affinity, points: Float[Array, "m 3"], trace: Trace, gradient: Match
) -> tuple[Affinity, Float[Array, "m 3"]]:
    """The gradients with respect to the affinity and the points."""
    u, v_before, v, _, sums = trace
    of_sums = gradient_of_sums(gradient, sums)
    pull = of_sums * u[-1][:, None]
    of_u = jnp.sum(of_sums * sums, axis=1) / u[-1]
    of_weighted, one = block.columns(pull), with_ones(points)
    of_v = jnp.sum(of_weighted * one, axis=1) - gradient.covered  # covered is 1 - v
    a, b = [], []
    for u_p, v_p in zip(u[::-1], [v, *v_before[:0:-1]], strict=True):
        a.append(-v_p * (v_p * of_v))
        b.append(gradient_of_scaling(u_p, block.rows(a[-1][:, None])[:, 0] + of_u))
        if len(b) < len(u):
            of_v, of_u = block.columns(b[-1][:, None])[:, 0], jnp.zeros_like(of_u)
    left = jnp.concatenate([u.T, jnp.stack(b[::-1], 1), pull], axis=1)
    right = jnp.concatenate([jnp.stack(a[::-1], 1), v_before.T, v[:, None] * one], axis=1)
    spent = block.spend(left, right)
    twice, beta = 2 * affinity.beta, affinity.beta
    of_affinity = Affinity(
        twice * spent.source, twice * spent.target, spent.beta, beta * spent.alpha
    )
    return of_affinity, (v[:, None] * of_weighted)[:, :3]


class Stored:
    """m_ij = exp(log affinity_ij - shift_i), zero where masked, and its products.

    The shift of a row is max(0, its largest log affinity), so that nothing overflows.
    """

    def __init__(
        self,
        affinity: Affinity,
        masks: tuple[Bool[Array, " n"], Bool[Array, " m"]],
        shift: Float[Array, " n"] | None = None,
    ):
        self.affinity: Affinity = affinity
        self.square: Array = squared_distances(affinity.source, affinity.target)
        log_values = masked(log_affinity(self.square, affinity.beta, affinity.alpha), *masks)
        self.shift: Array = jnp.maximum(jnp.max(log_values, axis=1), 0) if shift is None else shift
        block = jnp.exp(log_values - self.shift[:, None])
        sums = jnp.matmul(block, jnp.ones(block.shape[1], block.dtype), precision=_HIGHEST)
        # the barrier is that of `dense`: XLA makes both in one kernel, and stores no logarithms
        self.block: Array
        self.sums: Array  # of the rows
        self.block, self.sums = lax.optimization_barrier((block, sums))

    def rows(self, right: Float[Array, "m c"]) -> Float[Array, "n c"]:
        """m right."""
        return jnp.matmul(self.block, right, precision=_HIGHEST)

    def columns(self, left: Float[Array, "n c"]) -> Float[Array, "m c"]:
        """m' left."""
        return jnp.matmul(self.block.T, left, precision=_HIGHEST)

    def spend(self, left: Float[Array, "n r"], right: Float[Array, "m r"]) -> Spent:
        """The sums of share_ij = m_ij left_i . right_j."""
        share = self.block * jnp.matmul(left, right.T, precision=_HIGHEST)
        return Spent(
            jnp.matmul(share, self.affinity.target, precision=_HIGHEST),
            jnp.matmul(share.T, self.affinity.source, precision=_HIGHEST),
            jnp.sum(share * (self.affinity.alpha - self.square)),
            jnp.sum(share),
        )
