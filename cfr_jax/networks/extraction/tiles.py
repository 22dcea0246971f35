"""Tiles of rows that stay in a cache, and what is kept of them between two passes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

# Rows of 96 floats in flight, so that a tile's activations stay in a cache: two or three of them at
# a time forward, about eight backward.
ROWS = 4096
# Numbers of the second layer's output that are kept, 18 MiB. Made again they cost half of what the
# rest of the forward pass does; but a program with more than 32 MiB of scratch is given it anew in
# each call, page by page (glibc), which costs more than is saved.
KEPT = 9 << 19


def count_of(n: int, k: int) -> int:
    """Tiles for n points with k neighbors."""
    return -(-n * k // ROWS)


def cut(values: Array, count: int) -> Array:
    """Points (n, ...) cut into tiles (count, size, ...), padded to whole ones."""
    n = values.shape[0]
    size = -(-n // count)
    pad = [(0, count * size - n)] + [(0, 0)] * (values.ndim - 1)
    return jnp.pad(values, pad).reshape(count, size, *values.shape[1:])


def cut_rows(raw: Float[Array, "n k c"], count: int) -> Float[Array, "count rows c"]:
    """The same, neighbor by neighbor."""
    return cut(raw, count).reshape(count, -1, raw.shape[-1])


def kept_of(tiles: Float[Array, "count rows c"], width: int) -> int:
    """How many of the tiles are kept in a layer of that width."""
    count, rows, _ = tiles.shape
    return max(1, min(count, KEPT // (rows * width)))


def scan(
    step: Callable[..., tuple[Any, Any]],
    state: Any,
    kept: Float[Array, "some rows d"],
    again: Callable[[Array], Array],
    tiles: Float[Array, "count rows c"],
    *others: Array,
) -> tuple[Any, Any]:
    """`lax.scan` of step(state, z, raw, *others) over all tiles, where z is the second layer's
    output: kept of the first tiles, made `again` from the raw channels of the rest."""
    some = kept.shape[0]
    first, rest = ([x[part] for x in (tiles, *others)] for part in (slice(some), slice(some, None)))
    state, results = lax.scan(lambda state, x: step(state, *x), state, (kept, *first))
    if some < len(tiles):
        state, more = lax.scan(lambda state, x: step(state, again(x[0]), *x), state, tuple(rest))
        results = jax.tree.map(lambda *parts: jnp.concatenate(parts), results, more)
    return state, results
