"""The match by log-sum-exp over the padded block, as published with RPM-Net; slower."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax, nn
from jaxtyping import Array, Bool, Float

from cfr_jax.networks.sinkhorn.affinity import Affinity, Match, masked, match_of, with_ones


def match_in_log_space(
    affinity: Affinity,
    points: Float[Array, "m 3"],
    *,
    passes: int,
    source_mask: Bool[Array, " n"] | None = None,
    target_mask: Bool[Array, " m"] | None = None,
) -> Match:
    """`match`; every pass subtracts logarithms from the stored block."""
    padded = jnp.pad(masked(affinity.log(), source_mask, target_mask), ((0, 1), (0, 1)))
    for _ in range(passes):
        rows = nn.logsumexp(padded[:-1], axis=1, keepdims=True)
        padded = padded.at[:-1].add(-rows)
        columns = nn.logsumexp(padded[:, :-1], axis=0, keepdims=True)
        padded = padded.at[:, :-1].add(-columns)
    block = jnp.exp(padded[:-1, :-1])
    sums = jnp.matmul(block, with_ones(points), precision=lax.Precision.HIGHEST)
    return match_of(sums, jnp.sum(block, axis=0))
