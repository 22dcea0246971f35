"""The normalized block itself, of any affinities, with or without slack: for networks that need
more of it than where it puts the points."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from cfr_jax.networks.sinkhorn.affinity import masked

_HIGHEST = lax.Precision.HIGHEST


def log_plan(
    log_values: Float[Array, "n m"],
    *,
    passes: int,
    slack: bool = True,
    source_mask: Bool[Array, " n"] | None = None,
    target_mask: Bool[Array, " m"] | None = None,
) -> Float[Array, "n m"]:
    """The logarithm of what `passes` Sinkhorn passes make of exp(log_values), rows first.

    With `slack` a row and a column of ones stand beside them, as for `match`; without, every row
    and column is normalized alone. In scaling form: the block is read twice a pass and never
    rewritten, and a gradient through the passes stores vectors alone. Masked entries are minus
    infinity. Finite elsewhere for finite values.
    """
    log_values = masked(log_values, source_mask, target_mask)
    top = lax.stop_gradient(jnp.max(log_values, axis=1))
    # a masked row holds no finite number
    shift = jnp.maximum(top, 0) if slack else jnp.where(jnp.isfinite(top), top, 0)
    block = jnp.exp(log_values - shift[:, None])
    of_rows, of_columns = (jnp.exp(-shift), 1.0) if slack else (0.0, 0.0)

    def once(scaling: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        u = _inverse(jnp.matmul(block, scaling[1], precision=_HIGHEST) + of_rows)
        v = _inverse(jnp.matmul(u, block, precision=_HIGHEST) + of_columns)
        return (u, v), None

    n, m = block.shape
    start = jnp.ones(n, block.dtype), jnp.ones(m, block.dtype)
    (u, v), _ = lax.scan(once, start, length=passes)  # a loop: twenty passes compile as one
    return log_values - shift[:, None] + jnp.log(u)[:, None] + jnp.log(v)


def _inverse(sums: Float[Array, " n"]) -> Float[Array, " n"]:
    """1 / sums, with a floor below which nothing depends on them: the square of the inverse, which
    is in the derivative, stays finite."""
    floor = float(jnp.finfo(sums.dtype).tiny) ** 0.5
    sound = sums > floor
    return jnp.where(sound, 1 / jnp.where(sound, sums, 1), 1 / floor)
