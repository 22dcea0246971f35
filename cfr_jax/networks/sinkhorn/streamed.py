"""The match without its block: rows are computed from the features when needed, then dropped.

To scale a row, a pass needs all of its columns; to scale a column, it needs all of its rows. So the
match goes over blocks of whole rows: each block is scaled and adds its share to the columns at
once. One sweep over the rows is one pass, and one more sweep sums the targets. Only u, v and one
block of rows are in memory.

The gradient takes the same steps backward. Let a and b be the gradients of the column and the row
sums. Pass p sends a = -v^2 dv to the rows, and b = -u^2 (m a) to the columns of the pass before it,
where dv = m' b. In the end the gradient of log m_ij is m_ij times a product of two thin matrices,
sum_p (u_i a_j + b_i v_j) plus the weighted targets. The last sweep computes it and carries it on to
the features. There are as many sweeps as in the forward direction; the last one does three times
the work.
"""

from __future__ import annotations

import jax
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

# For a large target: enough rows in a block to make one read of the target's features pay off.
_LEAST_ROWS = 128
_HIGHEST = lax.Precision.HIGHEST

_Rows = tuple[Array, Array]  # features of a block of rows, and their mask
_Shifted = tuple[_Rows, Array]


def rows_of(m: int, entries: int) -> int:
    """The rows of a block with that many `entries` and m columns; at least 128."""
    return max(_LEAST_ROWS, entries // m)


def forward(
    affinity: Affinity,
    points: Float[Array, "m 3"],
    masks: tuple[Bool[Array, " n"], Bool[Array, " m"]],
    *,
    passes: int,
    rows: int,
) -> tuple[Match, Trace]:
    """The match and its trace, in memory for n + m rows and a block of at most `rows` rows."""
    n, m = affinity.source.shape[0], affinity.target.shape[0]
    blocks = _Blocks(affinity, masks, rows)
    tiny = jnp.finfo(points.dtype).tiny

    def one_pass(
        v: Array, shift: Array | None = None
    ) -> tuple[Array, tuple[Array, Array, Array], Array]:
        def rows(found: Array, here: tuple) -> tuple[Array, tuple[Array, Array]]:
            block, _, shift = blocks.make(*here)
            sums = jnp.matmul(block, v, precision=_HIGHEST) + jnp.exp(-shift)
            u = 1 / jnp.maximum(sums, tiny)
            return found + jnp.matmul(u, block, precision=_HIGHEST), (u, shift)

        found, (u, shift) = lax.scan(rows, jnp.zeros(m, v.dtype), (blocks.rows, shift))
        return 1 / (found + 1), (u, v, found), shift

    # The shift of a row is its largest entry. It is the same in every pass; the first one finds it.
    v, first, shift = one_pass(jnp.ones(m, points.dtype))
    v, others = lax.scan(lambda v, _: one_pass(v, shift)[:2], v, None, length=passes - 1)
    u, v_before, found = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, others)
    weighted = v[:, None] * with_ones(points)

    def last(here: tuple[_Rows, Array, Array]) -> Array:
        rows, shift, u = here
        return u[:, None] * jnp.matmul(blocks.make(rows, shift)[0], weighted, precision=_HIGHEST)

    sums = lax.map(last, (blocks.rows, shift, u[-1])).reshape(-1, 4)[:n]
    result = match_of(sums, v * found[-1])
    return result, Trace(u.reshape(passes, -1)[:, :n], v_before, v, shift.reshape(-1)[:n], sums)


def backward(
    affinity: Affinity,
    points: Float[Array, "m 3"],
    masks: tuple[Bool[Array, " n"], Bool[Array, " m"]],
    trace: Trace,
    gradient: Match,
    *,
    passes: int,
    rows: int,
) -> tuple[Affinity, Float[Array, "m 3"]]:
    """The gradients with respect to the affinity and the points, in as little memory."""
    n, m = affinity.source.shape[0], affinity.target.shape[0]
    blocks = _Blocks(affinity, masks, rows)
    u = jnp.stack([blocks.cut(one, 1) for one in trace.u])
    v_before, v, sums = trace.v_before, trace.v, trace.sums
    shifted = (blocks.rows, blocks.cut(trace.shift))

    # from the match to its sums, then to the last scaling of the rows
    of_sums = gradient_of_sums(gradient, sums)
    pull = blocks.cut(of_sums) * u[-1][..., None]
    of_u = jnp.sum(blocks.cut(of_sums * sums), axis=-1) / u[-1]

    def columns(total: Array, here: tuple[_Shifted, Array]) -> tuple[Array, None]:
        rows, pull = here
        block, *_ = blocks.make(*rows)
        return total + jnp.matmul(block.T, pull, precision=_HIGHEST), None

    of_weighted, _ = lax.scan(columns, jnp.zeros((m, 4), points.dtype), (shifted, pull))
    one = with_ones(points)
    of_v = jnp.sum(of_weighted * one, axis=1) - gradient.covered  # covered is 1 - v

    def of_rows(block: Array, a: Array, u: Array, of_u: Array) -> Array:
        return gradient_of_scaling(u, jnp.matmul(block, a, precision=_HIGHEST) + of_u)

    def back(
        state: tuple[Array, Array], one_pass: tuple[Array, Array]
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        of_v, of_u = state
        u, v = one_pass
        a = -v * (v * of_v)

        def step(total: Array, here: tuple[_Shifted, Array, Array]) -> tuple[Array, Array]:
            rows, u, of_u = here
            block, *_ = blocks.make(*rows)
            b = of_rows(block, a, u, of_u)
            return total + jnp.matmul(b, block, precision=_HIGHEST), b

        of_v, b = lax.scan(step, jnp.zeros_like(v), (shifted, u, of_u))
        return (of_v, jnp.zeros_like(of_u)), (a, b)

    v_after = jnp.concatenate([v_before[1:], v[None]])
    (of_v, of_u), (a, b) = lax.scan(back, (of_v, of_u), (u[1:], v_after[1:]), reverse=True)
    a_first = -v_after[0] * (v_after[0] * of_v)
    a = jnp.concatenate([a_first[None], a])

    # log m_ij receives m_ij times left_i . right_j
    right = jnp.concatenate([a, v_before, (v[:, None] * one).T])

    def spend(
        state: tuple[Array, Array, Array], here: tuple
    ) -> tuple[tuple[Array, Array, Array], Array]:
        rows, u, b, pull, of_u = here
        of_target, of_beta, of_alpha = state
        block, square, _ = blocks.make(*rows)
        b_first = of_rows(block, a_first, u[0], of_u)
        left = jnp.concatenate([u, b_first[None], b, pull.T])
        share = block * jnp.matmul(left.T, right, precision=_HIGHEST)
        state = (
            of_target + jnp.matmul(share.T, rows[0][0], precision=_HIGHEST),
            of_beta + jnp.sum(share * (affinity.alpha - square)),
            of_alpha + jnp.sum(share),
        )
        return state, jnp.matmul(share, affinity.target, precision=_HIGHEST)

    zero = jnp.zeros((), points.dtype)
    per_block = (shifted, jnp.moveaxis(u, 0, 1), jnp.moveaxis(b, 0, 1), pull, of_u)
    (of_target, of_beta, of_alpha), of_source = lax.scan(
        spend, (jnp.zeros_like(affinity.target), zero, zero), per_block
    )
    twice = 2 * affinity.beta
    of_affinity = Affinity(
        twice * of_source.reshape(-1, of_source.shape[-1])[:n],
        twice * of_target,
        of_beta,
        affinity.beta * of_alpha,
    )
    return of_affinity, (v[:, None] * of_weighted)[:, :3]


class _Blocks:
    """The block in pieces: rows of the source, cut and padded; affinities are made on demand."""

    def __init__(self, affinity: Affinity, masks: tuple[Array, Array], most_rows: int) -> None:
        self.affinity, self.target_mask = affinity, masks[1]
        n = affinity.source.shape[0]
        self.count = -(-n // most_rows)
        self.size = -(-n // self.count)
        self.rows = self.cut(affinity.source), self.cut(masks[0])  # the padding is masked

    def cut(self, values: Float[Array, "n ..."] | Bool[Array, " n"], fill: int = 0) -> Array:
        """(n, ...) as (blocks, rows, ...)."""
        more = self.count * self.size - values.shape[0]
        pad = [(0, more)] + [(0, 0)] * (values.ndim - 1)
        padded = jnp.pad(values, pad, constant_values=fill)
        return padded.reshape(self.count, self.size, *values.shape[1:])

    def make(self, rows: _Rows, shift: Array | None = None) -> tuple[Array, Array, Array]:
        """exp(log m - shift), the squared distances, and the shift of a block of rows."""
        features, mask = rows
        beta, alpha = self.affinity.beta, self.affinity.alpha
        square = squared_distances(features, self.affinity.target)
        log_values = masked(log_affinity(square, beta, alpha), mask, self.target_mask)
        if shift is None:
            shift = jnp.maximum(jnp.max(log_values, axis=1), 0)
        return jnp.exp(log_values - shift[:, None]), square, shift
