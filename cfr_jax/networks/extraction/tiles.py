"""Tiles of rows, sized for the platform, and what is kept between two passes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float


class Limits(NamedTuple):
    """How large a step is, and how much of the second layer's output is kept."""

    rows: int = 4096
    """Rows of a tile, one per neighbor. On a CPU the activations of a tile stay in the cache: two
    or three arrays of 96 floats per row at a time in the forward pass, about eight in the backward
    pass."""
    kept: int = 9 << 19
    """How many numbers of the second layer's output are kept: 18 MiB. To recompute them costs half
    as much as the rest of the forward pass. But if a program needs more than 32 MiB of scratch
    memory, glibc maps it again in every call, page by page, and that costs more than it saves."""
    at_once: int = 1
    """Tiles per step. An accelerator wants the whole cloud in one step: the kernels of a loop's
    steps would each have too little to do."""


CPU = Limits()
# 2 million rows: 32,000 points with 64 neighbors, 0.8 GiB per activation; 2 GiB are kept
ACCELERATOR = Limits(kept=1 << 29, at_once=512)


class Tiling(NamedTuple):
    """`number` tiles of `size` points each; the last may be padded."""

    number: int
    size: int


def tiling_of(n: int, k: int, limits: Limits) -> Tiling:
    """The tiles of n points with k neighbors."""
    count = -(-n * k // limits.rows)
    size = -(-n // count)
    together = min(count, limits.at_once)
    return Tiling(-(-count // together), together * size)


def kept_of(tiling: Tiling, k: int, width: int, limits: Limits) -> int:
    """How many of the tiles are kept, for a layer of this width."""
    return max(1, min(tiling.number, limits.kept // (tiling.size * k * width)))


def cut(values: Array, tiling: Tiling) -> Array:
    """Points (n, ...) cut into tiles (count, size, ...); the last tile is padded."""
    more = tiling.number * tiling.size - values.shape[0]
    padded = jnp.pad(values, [(0, more)] + [(0, 0)] * (values.ndim - 1))
    return padded.reshape(*tiling, *values.shape[1:])


def cut_rows(raw: Float[Array, "n k c"], tiling: Tiling) -> Float[Array, "count rows c"]:
    """Neighbors (n, k, c) cut into tiles (count, size k, c): one row per neighbor."""
    return cut(raw, tiling).reshape(tiling.number, -1, raw.shape[-1])


def scan(
    step: Callable[..., tuple[Any, Any]],
    state: Any,
    kept: Float[Array, "some rows d"],
    again: Callable[[Array], Array],
    tiles: Float[Array, "count rows c"],
    *others: Array,
) -> tuple[Any, Any]:
    """`lax.scan` of step(state, z, raw, *others) over all tiles.

    z is the second layer's output: `kept` for the first tiles, recomputed by `again` from the raw
    channels for the rest.
    """
    some = kept.shape[0]
    first, rest = ([x[part] for x in (tiles, *others)] for part in (slice(some), slice(some, None)))
    results = []
    if some:
        state, result = each(lambda state, x: step(state, *x), state, (kept, *first))
        results.append(result)
    if some < len(tiles):
        state, result = each(lambda state, x: step(state, again(x[0]), *x), state, tuple(rest))
        results.append(result)
    return state, jax.tree.map(lambda *parts: jnp.concatenate(parts), *results)


def each(step: Callable[[Any, Any], tuple[Any, Any]], state: Any, tiles: Any) -> tuple[Any, Any]:
    """`lax.scan`, but without a loop if there is only one tile."""
    if len(jax.tree.leaves(tiles)[0]) > 1:
        return lax.scan(step, state, tiles)
    state, result = step(state, jax.tree.map(lambda tile: tile[0], tiles))
    return state, jax.tree.map(lambda tile: tile[None], result)
