"""Linear, GroupNorm, ReLU and the maximum over all points, in one step: PointNet's wide last layer.

Of n rows of 1,024 channels, only one row per channel survives the maximum. The statistics of the
norm follow from the mean and covariance of the narrow input. The norm and the ReLU are monotonic,
so the maximum can be taken before them. The gradient is one row per channel, plus what the norm
takes out of it. That part is linear in the input, so it needs a product as narrow as the input
instead of one as wide as the output. Arrays as wide as the output exist only for one tile of rows
at a time.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from cfr_jax.networks.layers import Layer, Norm, norm_of, projections
from cfr_jax.runtime.tracing.gradients import with_gradient

_HIGHEST = lax.Precision.HIGHEST  # for products that become variances
# Rows of a tile. On a CPU that is 64 MiB of 1,024 channels: clouds of the usual size are one tile.
_ON_CPU, _ELSEWHERE = 1 << 14, 1 << 18

_Needed = tuple[tuple[Array, Array, Array], Norm, Array, Array]


def pooled_layer(
    layer: Layer,
    x: Float[Array, "n i"],
    *,
    groups: int,
    mask: Bool[Array, " n"] | None = None,
    on_cpu: int = _ON_CPU,
    elsewhere: int = _ELSEWHERE,
) -> Float[Array, " o"]:
    """The maximum over the valid rows of relu(groupnorm(x kernel + bias)).

    The derivative has a rule of its own. Arrays as wide as the output have at most `on_cpu` rows on
    a CPU and `elsewhere` rows on other platforms.
    """
    valid = jnp.ones(x.shape[0], x.dtype) if mask is None else mask.astype(x.dtype)
    there = functools.partial(_forward, groups=groups, rows=(on_cpu, elsewhere))
    return with_gradient(there, functools.partial(_backward, groups), layer, x, valid)


def _forward(
    layer: Layer, x: Array, valid: Array, *, groups: int, rows: tuple[int, int]
) -> tuple[Array, _Needed]:
    count = jnp.maximum(jnp.sum(valid), 1)
    mean = valid @ x / count
    centered = (x - mean) * valid[:, None]
    covariance = jnp.matmul(centered.T, centered, precision=_HIGHEST) / count
    channel_mean = mean @ layer.kernel + layer.bias
    norm = norm_of(channel_mean, ((covariance @ layer.kernel) * layer.kernel).sum(0), groups)
    # for a negative scale the smallest value becomes the largest
    sign = jnp.where(layer.scale >= 0, 1, -1).astype(x.dtype)
    high, chosen = _highest(x, layer.kernel * sign, valid, rows)
    normal = (high * sign + layer.bias - norm.mean) * norm.rate
    pooled = jax.nn.relu(normal * layer.scale + layer.shift)
    return pooled, ((mean, covariance, channel_mean), norm, normal, chosen)


def _highest(x: Array, kernel: Array, valid: Array, rows: tuple[int, int]) -> tuple[Array, Array]:
    """Per channel, the largest value of x kernel over the valid rows, and the first row with it.

    If no row is valid, the value is 0 and the row is arbitrary.
    """
    n = x.shape[0]
    if n <= min(rows):
        high, chosen = _of_tile(x, kernel, valid, 0, n - 1)
    else:
        cpu, default = (functools.partial(_of_tiles, rows=count) for count in rows)
        high, chosen = lax.platform_dependent(x, kernel, valid, cpu=cpu, default=default)
    return jnp.where(jnp.isfinite(high), high, 0), jnp.minimum(chosen, n - 1)


def _of_tile(
    x: Array, kernel: Array, valid: Array, start: Array | int, last: int
) -> tuple[Array, Array]:
    z = jnp.where(valid[:, None] > 0, x @ kernel, -jnp.inf)
    high = jnp.max(z, axis=0)
    # two plain reductions: XLA's argmax on CPU is not vectorized
    rows = start + jnp.arange(x.shape[0], dtype=jnp.int32)[:, None]
    return high, jnp.min(jnp.where(z >= high, rows, last), axis=0)


def _of_tiles(x: Array, kernel: Array, valid: Array, *, rows: int) -> tuple[Array, Array]:
    n = x.shape[0]
    if n <= rows:
        return _of_tile(x, kernel, valid, 0, n - 1)

    def merge(
        best: tuple[Array, Array], tile: tuple[Array, Array, Array]
    ) -> tuple[tuple[Array, Array], None]:
        x, valid, start = tile
        high, chosen = _of_tile(x, kernel, valid, start, n - 1)
        higher = high > best[0]
        return (jnp.where(higher, high, best[0]), jnp.where(higher, chosen, best[1])), None

    count = -(-n // rows)
    more = count * rows - n
    tiles = (
        jnp.pad(x, ((0, more), (0, 0))).reshape(count, rows, -1),
        jnp.pad(valid, (0, more)).reshape(count, rows),
        rows * jnp.arange(count, dtype=jnp.int32),
    )
    lowest = jnp.full(kernel.shape[1], -jnp.inf, x.dtype), jnp.zeros(kernel.shape[1], jnp.int32)
    return lax.scan(merge, lowest, tiles)[0]


def _backward(
    groups: int, arguments: tuple[Layer, Array, Array], needed: _Needed, gradient: Array
) -> tuple[Layer, Array, None]:
    layer, x, valid = arguments
    (mean, covariance, channel_mean), norm, normal, chosen = needed
    count = jnp.maximum(jnp.sum(valid), 1)
    shift = jnp.where(normal * layer.scale + layer.shift > 0, gradient, 0)
    scale = shift * normal
    flat, tilt = projections(layer, shift, scale, count, groups)
    sparse = shift * layer.scale * norm.rate
    # the normalized values are slope (x - mean) + offset
    slope, offset = layer.kernel * norm.rate, (channel_mean - norm.mean) * norm.rate
    level = (flat + tilt * offset) * norm.rate
    steep = tilt * norm.rate
    kernel = x[chosen].T * sparse - count * (jnp.outer(mean, level) + (covariance @ slope) * steep)
    dense = level @ layer.kernel.T + (x - mean) @ ((slope * steep) @ layer.kernel.T)
    d_x = -dense * valid[:, None]
    d_x = d_x.at[chosen].add(sparse[:, None] * layer.kernel.T)
    return Layer(kernel, sparse - count * level, scale, shift), d_x, None
