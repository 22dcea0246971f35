"""The MLP and its maximum, in two passes over tiles."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from cfr_jax.networks.extraction.tiles import count_of, cut, cut_rows, kept_of, scan
from cfr_jax.networks.layers import Layer, Norm, fold, norm_of

_HIGHEST = lax.Precision.HIGHEST  # for what becomes a variance


class Kept(NamedTuple):
    """What the gradient needs of the values."""

    norms: tuple[Norm, Norm, Norm]
    normal: Float[Array, "n d"]
    """The pooled values, normalized, before scale and shift."""
    second: Float[Array, "some rows d"]
    """The second layer's output, bias left out, of the tiles that are kept."""


def forward(
    layers: tuple[Layer, Layer, Layer],
    raw: Float[Array, "n k c"],
    valid: Float[Array, " n"],
    *,
    groups: int,
) -> tuple[Float[Array, "n d"], Kept]:
    """The pooled features, and what is kept for the gradient; all zero where no point is valid."""

    n, k, _ = raw.shape
    widths = [layer.bias.size for layer in layers]
    tiles = cut_rows(raw, count_of(n, k))

    def of_points():
        return _forward(layers, raw, tiles, valid, groups)

    def of_none():
        norms = tuple(Norm(*2 * (jnp.zeros(width, raw.dtype),)) for width in widths)
        pooled = jnp.zeros((n, widths[-1]), raw.dtype)
        kept = jnp.zeros((kept_of(tiles, widths[1]), tiles.shape[1], widths[1]), raw.dtype)
        return pooled, Kept(norms, pooled, kept)

    # To XLA's scheduler a branch is one operation: so the clouds of a pair come one after the other
    # and take the same scratch. (The barrier hides from it that without a mask all are valid.)
    some = jnp.any(lax.optimization_barrier(valid) > 0)
    return lax.cond(some, of_points, of_none)


def _forward(layers, raw, tiles, valid, groups):
    one, two, three = layers
    n, k, _ = raw.shape
    rows = jnp.maximum(jnp.sum(valid) * k, 1)

    norm_one = norm_of(*_moments_of_first(one, tiles, valid, rows), groups)
    kernel_one, bias_one = fold(one, norm_one)

    def second(raw):
        return jax.nn.relu(raw @ kernel_one + bias_one) @ two.kernel

    # Both passes leave sums per point, and the mask weighs them afterwards: reductions that follow
    # a product directly are fused into it on CPU.
    def statistics(_, raw):
        z = second(raw)
        return None, (z, _sums_of_neighbors(z, k))

    some = kept_of(tiles, two.bias.size)
    _, (kept, sums) = lax.scan(statistics, None, tiles[:some])
    if some < len(tiles):
        more = lax.map(lambda raw: statistics(None, raw)[1][1], tiles[some:])
        sums = jax.tree.map(lambda *parts: jnp.concatenate(parts), sums, more)
    norm_two = norm_of(*_moments(sums, valid, rows, two.bias), groups)
    gain = two.scale * norm_two.rate
    level = (two.bias - norm_two.mean) * gain + two.shift

    # under a negative scale the smallest value becomes the largest
    sign = jnp.where(three.scale >= 0, 1, -1).astype(raw.dtype)
    kernel_three = three.kernel * sign

    def extremes(_, z, raw):
        z = jax.nn.relu(z * gain + level) @ kernel_three
        return None, (_sums_of_neighbors(z, k), z.reshape(-1, k, z.shape[-1]).max(1))

    _, (sums, high) = scan(extremes, None, kept, second, tiles)
    norm_three = norm_of(*_moments(sums, valid, rows, three.bias, sign), groups)
    extreme = high.reshape(-1, high.shape[-1])[:n] * sign + three.bias
    normal = (extreme - norm_three.mean) * norm_three.rate
    pooled = jax.nn.relu(normal * three.scale + three.shift)
    return pooled, Kept((norm_one, norm_two, norm_three), normal, kept)


def _sums_of_neighbors(z, k):
    each = z.reshape(-1, k, z.shape[-1])
    return each.sum(1), (each * each).sum(1)


def _moments(sums, valid, rows, bias, sign=1):
    """Mean and variance of a layer's output from each point's sums over its neighbors."""
    total, square = (valid @ each.reshape(-1, bias.size)[: valid.size] / rows for each in sums)
    return total * sign + bias, square - total * total


def _moments_of_first(layer, tiles, valid, rows):
    # tile by tile: on CPU the product copies what it is made of
    count, _, channels = tiles.shape
    weights = cut(valid, count)
    each = tiles.reshape(*weights.shape, -1, channels)
    mean = jnp.sum(weights[:, :, None, None] * each, (0, 1, 2)) / rows

    def add(gram, tile):
        raw, weight = tile
        centered = ((raw - mean) * weight[:, None, None]).reshape(-1, channels)
        return gram + jnp.matmul(centered.T, centered, precision=_HIGHEST), None

    gram, _ = lax.scan(add, jnp.zeros((channels, channels), tiles.dtype), (each, weights))
    covariance = gram / rows
    return mean @ layer.kernel + layer.bias, ((covariance @ layer.kernel) * layer.kernel).sum(0)
