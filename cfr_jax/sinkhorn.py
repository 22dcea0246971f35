"""Sinkhorn normalization with slack: which source point corresponds to which target point, softly.

A row and a column of ones stand beside the affinities m = exp(log_affinity) and take what has no
partner; they are never normalized themselves. One pass divides every real row by its sum, then
every real column by its sum, slack included. The normalized block is diag(u) m diag(v), with u <- 1
/ (m v + 1) and v <- 1 / (m' u + 1) from v = 1: matrix-vector products only, the block itself is
read and never rewritten ("log-free", Hisadome & Matsui, 2021; scaling form after Cuturi, 2013).
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax, nn
from jaxtyping import Array, Bool, Float

_HIGHEST = lax.Precision.HIGHEST


class Match(NamedTuple):
    """Soft correspondence of n source points with m target points."""

    weights: Float[Array, " n"]
    """Row sums: how much of each source point found a partner, in [0, 1]."""
    targets: Float[Array, "n 3"]
    """Where its partners are, on average."""
    covered: Float[Array, " m"]
    """Column sums: how much of each target point was found."""


def match(
    log_affinity: Float[Array, "n m"],
    points: Float[Array, "m 3"],
    *,
    passes: int,
    source_mask: Bool[Array, " n"] | None = None,
    target_mask: Bool[Array, " m"] | None = None,
) -> Match:
    """Normalizes the affinities by `passes` passes and averages `points` with them.

    Finite for every finite `log_affinity`: each row is shifted by r = max(0, its largest entry), so
    that no exponential overflows, and its scaling is kept as u e^r. Masked points neither give nor
    take. `passes` is static; differentiates through the passes.
    """
    log_affinity = _checked(log_affinity, passes, source_mask, target_mask)
    # the result does not depend on the shift, so it needs no gradient
    shift = lax.stop_gradient(jnp.maximum(jnp.max(log_affinity, axis=1), 0))
    block = jnp.exp(log_affinity - shift[:, None])
    slack = jnp.exp(-shift)
    tiny = jnp.finfo(block.dtype).tiny
    v = jnp.ones(block.shape[1], block.dtype)
    for _ in range(passes):
        # the floor is reached only where a whole row has vanished: it then stays without partner
        u = 1 / jnp.maximum(jnp.matmul(block, v, precision=_HIGHEST) + slack, tiny)
        v = 1 / (jnp.matmul(u, block, precision=_HIGHEST) + 1)
    sums = u[:, None] * jnp.matmul(
        block, v[:, None] * jnp.pad(points, ((0, 0), (0, 1)), constant_values=1), precision=_HIGHEST
    )
    weights = sums[:, 3]
    covered = v * jnp.matmul(u, block, precision=_HIGHEST)
    return Match(weights, sums[:, :3] / (weights + 1e-5)[:, None], covered)


def match_in_log_space(
    log_affinity: Float[Array, "n m"],
    points: Float[Array, "m 3"],
    *,
    passes: int,
    source_mask: Bool[Array, " n"] | None = None,
    target_mask: Bool[Array, " m"] | None = None,
) -> Match:
    """The same by log-sum-exp over the padded block, as RPM-Net published it; slower."""
    log_affinity = _checked(log_affinity, passes, source_mask, target_mask)
    padded = jnp.pad(log_affinity, ((0, 1), (0, 1)))
    for _ in range(passes):
        rows = nn.logsumexp(padded[:-1], axis=1, keepdims=True)
        padded = padded.at[:-1].add(-rows)
        columns = nn.logsumexp(padded[:, :-1], axis=0, keepdims=True)
        padded = padded.at[:, :-1].add(-columns)
    block = jnp.exp(padded[:-1, :-1])
    weights = jnp.sum(block, axis=1)
    targets = jnp.matmul(block, points, precision=_HIGHEST) / (weights + 1e-5)[:, None]
    return Match(weights, targets, jnp.sum(block, axis=0))


def _checked(log_affinity, passes, source_mask, target_mask):
    """Log affinities with masked rows and columns at minus infinity."""
    if passes < 1:
        raise ValueError(f"passes: got {passes}, wanted at least 1")
    if source_mask is not None:
        log_affinity = jnp.where(source_mask[:, None], log_affinity, -jnp.inf)
    if target_mask is not None:
        log_affinity = jnp.where(target_mask, log_affinity, -jnp.inf)
    return log_affinity
