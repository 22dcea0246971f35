"""The MLP and its maximum, in two passes over tiles."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from cfr_jax.networks.extraction import whole
from cfr_jax.networks.extraction.tiles import Limits, cut, cut_rows, each, kept_of, scan, tiling_of
from cfr_jax.networks.layers import Layer, Norm, fold, norm_of

_HIGHEST = lax.Precision.HIGHEST  # for products that become variances


class Intermediates(NamedTuple):
    """What the forward pass keeps for the gradient."""

    norms: tuple[Norm, Norm, Norm]
    normal: Float[Array, "n d"]
    """The pooled values, normalized, before scale and shift."""
    second: Float[Array, "rows d"]
    """The second layer's output without its bias, for the first `rows` rows."""


def forward(
    layers: tuple[Layer, Layer, Layer],
    raw: Float[Array, "n k c"],
    valid: Float[Array, " n"],
    *,
    groups: int,
    limits: Limits,
    rows_kept: int,
) -> tuple[Float[Array, "n d"], Intermediates]:
    """The pooled features, and what the gradient needs, including `rows_kept` rows of the second
    layer's output. Everything is finite, even if no point is valid."""
    n = raw.shape[0]
    widths = [layer.bias.size for layer in layers]

    at_once = limits.at_once > 1 and tiling_of(n, raw.shape[1], limits).number == 1

    def of_points() -> tuple[Array, Intermediates]:
        run = _of_whole if at_once else _of_tiles
        pooled, kept = run(layers, raw, valid, groups, limits)
        second = kept.second.reshape(-1, widths[1])[:rows_kept]
        more = rows_kept - len(second)  # the tiles of another platform may hold more padding
        return pooled, kept._replace(second=jnp.pad(second, ((0, more), (0, 0))))

    def of_none() -> tuple[Array, Intermediates]:
        one, two, three = (Norm(*2 * (jnp.zeros(width, raw.dtype),)) for width in widths)
        pooled = jnp.zeros((n, widths[-1]), raw.dtype)
        return pooled, Intermediates(
            (one, two, three), pooled, jnp.zeros((rows_kept, widths[1]), raw.dtype)
        )

    if limits.at_once > 1:
        return of_points()  # an accelerator would have to ask the host which branch to take

    # To XLA's scheduler a branch is one operation. So on a CPU the two clouds of a pair run one
    # after the other and share their scratch memory. (Without a mask all points are valid; the
    # barrier hides this from XLA, which would otherwise remove the branch.)
    some = jnp.any(lax.optimization_barrier(valid) > 0)
    return lax.cond(some, of_points, of_none)


def _of_whole(
    layers: tuple[Layer, Layer, Layer], raw: Array, valid: Array, groups: int, _: Limits
) -> tuple[Array, Intermediates]:
    pooled, values = whole.forward(layers, raw, valid, groups=groups, stored=raw.dtype)
    return pooled, Intermediates(values.norms, values.normal, values.z_two)


def _of_tiles(
    layers: tuple[Layer, Layer, Layer], raw: Array, valid: Array, groups: int, limits: Limits
) -> tuple[Array, Intermediates]:
    one, two, three = layers
    n, k, _ = raw.shape
    rows = jnp.maximum(jnp.sum(valid) * k, 1)
    tiling = tiling_of(n, k, limits)
    tiles = cut_rows(raw, tiling)

    norm_one = norm_of(*_moments_of_first(one, tiles, cut(valid, tiling), rows), groups)
    kernel_one, bias_one = fold(one, norm_one)

    def second(raw: Array) -> Array:
        return jax.nn.relu(raw @ kernel_one + bias_one) @ two.kernel

    # Both passes produce sums per point, and the mask is applied afterwards: on a CPU, a reduction
    # that directly follows a product is fused into it.
    def statistics(_: None, raw: Array) -> tuple[None, tuple[Array, tuple[Array, Array]]]:
        z = second(raw)
        return None, (z, _sums_of_neighbors(z, k))

    some = kept_of(tiling, k, two.bias.size, limits)
    _, (kept, sums) = each(statistics, None, tiles[:some])
    if some < len(tiles):
        more = lax.map(lambda raw: statistics(None, raw)[1][1], tiles[some:])
        sums = jax.tree.map(lambda *parts: jnp.concatenate(parts), sums, more)
    norm_two = norm_of(*_moments(sums, valid, rows, two.bias), groups)
    gain = two.scale * norm_two.rate
    level = (two.bias - norm_two.mean) * gain + two.shift

    # under a negative scale the smallest value becomes the largest
    sign = jnp.where(three.scale >= 0, 1, -1).astype(raw.dtype)
    kernel_three = three.kernel * sign

    def extremes(_: None, z: Array, raw: Array) -> tuple[None, tuple[tuple[Array, Array], Array]]:
        z = jax.nn.relu(z * gain + level) @ kernel_three
        return None, (_sums_of_neighbors(z, k), z.reshape(-1, k, z.shape[-1]).max(1))

    _, (sums, high) = scan(extremes, None, kept, second, tiles)
    norm_three = norm_of(*_moments(sums, valid, rows, three.bias, sign), groups)
    extreme = high.reshape(-1, high.shape[-1])[:n] * sign + three.bias
    normal = (extreme - norm_three.mean) * norm_three.rate
    pooled = jax.nn.relu(normal * three.scale + three.shift)
    return pooled, Intermediates((norm_one, norm_two, norm_three), normal, kept)


def _sums_of_neighbors(z: Array, k: int) -> tuple[Array, Array]:
    z = z.reshape(-1, k, z.shape[-1])
    return z.sum(1), (z * z).sum(1)


def _moments(
    sums: tuple[Array, Array], valid: Array, rows: Array, bias: Array, sign: Array | int = 1
) -> tuple[Array, Array]:
    """Mean and variance of a layer's output from each point's sums over its neighbors."""
    total, square = (valid @ sum_.reshape(-1, bias.size)[: valid.size] / rows for sum_ in sums)
    return total * sign + bias, square - total * total


def _moments_of_first(
    layer: Layer, tiles: Array, weights: Array, rows: Array
) -> tuple[Array, Array]:
    # tile by tile: on a CPU the product copies its operands
    channels = tiles.shape[-1]
    neighbors = tiles.reshape(*weights.shape, -1, channels)
    mean = jnp.sum(weights[:, :, None, None] * neighbors, (0, 1, 2)) / rows

    def add(gram: Array, tile: tuple[Array, Array]) -> tuple[Array, None]:
        raw, weight = tile
        centered = ((raw - mean) * weight[:, None, None]).reshape(-1, channels)
        return gram + jnp.matmul(centered.T, centered, precision=_HIGHEST), None

    gram, _ = each(add, jnp.zeros((channels, channels), tiles.dtype), (neighbors, weights))
    covariance = gram / rows
    return mean @ layer.kernel + layer.bias, ((covariance @ layer.kernel) * layer.kernel).sum(0)
