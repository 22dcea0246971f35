"""The MLP and its maximum on a whole cloud at once, as accelerators like it.

There it waits for memory and not for arithmetic, so it is written for few passes over n k rows: the
raw channels lie in planes, so that what makes them reads and writes neighbors side by side; a
channel of ones carries the first bias into the product; and what the second and the third layer are
asked for, sums, sums of squares and the maximum, is found in one reading.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from cfr_jax.networks.layers import Layer, Norm, fold, norm_of

_HIGHEST = lax.Precision.HIGHEST  # for what becomes a variance
_SLICES = 32  # all of 64 would take a second longer to compile


class Values(NamedTuple):
    """What the layers made of a cloud, for gradients."""

    means: tuple[Array, Array, Array]
    """Of the raw channels, and of the outputs of the second and the third layer."""
    covariance: Float[Array, "c c"]
    """Of the raw channels."""
    norms: tuple[Norm, Norm, Norm]
    normal: Float[Array, "n d"]
    """The pooled values, normalized, before scale and shift."""
    x: Float[Array, "n k c1"]
    """The raw channels and a one."""
    y_one: Float[Array, "n k d"]
    """The layers' inputs (y) and outputs before their bias (z)."""
    z_two: Float[Array, "n k d"]
    y_two: Float[Array, "n k d"]
    z_three: Float[Array, "n k d"]
    """Its sign changed where the scale is negative."""


def forward(
    layers: tuple[Layer, Layer, Layer],
    raw: Float[Array, "n k c"],
    valid: Float[Array, " n"],
    *,
    groups: int,
    stored: DTypeLike,
) -> tuple[Float[Array, "n d"], Values]:
    """The pooled features; `stored` is what activations are kept in. What nobody looks at of the
    values is never stored."""
    one, two, three = layers
    planes = jnp.moveaxis(raw, -1, 0)
    planes = lax.optimization_barrier(planes.reshape(-1)).reshape(planes.shape)  # in this order
    count = jnp.maximum(jnp.sum(valid) * raw.shape[1], 1)

    mean, covariance = _moments_of_raw(planes, valid, count)
    spread = ((covariance @ one.kernel) * one.kernel).sum(0)
    norm_one = norm_of(mean @ one.kernel + one.bias, spread, groups)
    kernel_one, bias_one = fold(one, norm_one)
    x = jnp.pad(planes, ((0, 1), (0, 0), (0, 0)), constant_values=1).astype(stored)
    x = jnp.moveaxis(x, 0, -1)
    y_one = jax.nn.relu(x @ jnp.vstack([kernel_one, bias_one]).astype(stored))
    # the barriers: XLA would make what is multiplied again wherever it is read, and would copy both
    # clouds of a pair into one array, as they are multiplied by the same kernel
    y_one, kernel_two = lax.optimization_barrier((y_one, two.kernel.astype(stored)))

    z_two = y_one @ kernel_two
    sums, squares, _ = _over_neighbors(z_two, raw.dtype)
    mean_two, norm_two = _norm(sums, squares, valid, count, two.bias, groups)
    gain = two.scale * norm_two.rate
    level = (two.bias - norm_two.mean) * gain + two.shift
    y_two = jax.nn.relu(z_two.astype(raw.dtype) * gain + level).astype(stored)

    # under a negative scale the smallest value becomes the largest
    sign = jnp.where(three.scale >= 0, 1, -1).astype(raw.dtype)
    kernel_three = (three.kernel * sign).astype(stored)
    y_two, kernel_three = lax.optimization_barrier((y_two, kernel_three))
    z_three = y_two @ kernel_three
    sums, squares, high = _over_neighbors(z_three, raw.dtype)
    mean_three, norm_three = _norm(sums, squares, valid, count, three.bias, groups, sign)
    normal = (high * sign + three.bias - norm_three.mean) * norm_three.rate
    pooled = jax.nn.relu(normal * three.scale + three.shift)
    values = Values(
        (mean, mean_two, mean_three),
        covariance,
        (norm_one, norm_two, norm_three),
        normal,
        x,
        y_one,
        z_two,
        y_two,
        z_three,
    )
    return pooled, values


def _moments_of_raw(planes: Array, valid: Array, count: Array) -> tuple[Array, Array]:
    """Mean and covariance of the raw channels. Summed, not multiplied: a product of so few columns
    leaves a GPU's units empty, and would be rounded there."""

    def mean_of(values: Array) -> Array:
        return jnp.sum(values * valid[:, None], (1, 2)) / count

    mean = mean_of(planes)
    centered = planes - mean[:, None, None]
    row, column = np.triu_indices(len(planes))
    sums = mean_of(centered[row] * centered[column])
    place = np.zeros((len(planes), len(planes)), np.int32)
    place[row, column] = place[column, row] = np.arange(len(row))
    return mean, sums[place]


def _over_neighbors(z: Array, dtype: DTypeLike) -> tuple[Array, Array, Array]:
    """Sums, sums of squares and the largest value over each point's neighbors, (n, d) each.

    XLA would read z for each of them. So a part of the way is written out as sums of slices, which
    become one kernel that reads z once; what is left to reduce is small. The barriers keep XLA
    from looking through the shapes; and as they are flat, it cannot turn z over, either.
    """
    _, k, width = z.shape
    count = math.gcd(k, _SLICES)
    z = lax.optimization_barrier(z.reshape(-1)).astype(dtype)
    slices = z.reshape(-1, count, k // count, width)
    first, *rest = (slices[:, i] for i in range(count))
    sums, squares, high = first, first * first, first
    for each in rest:
        sums, squares, high = sums + each, squares + each * each, jnp.maximum(high, each)
    found = lax.optimization_barrier([part.reshape(-1) for part in (sums, squares, high)])
    sums, squares, high = (part.reshape(-1, k // count, width) for part in found)
    return sums.sum(1), squares.sum(1), high.max(1)


def _norm(
    sums: Array,
    squares: Array,
    valid: Array,
    count: Array,
    bias: Array,
    groups: int,
    sign: Array | int = 1,
) -> tuple[Array, Norm]:
    """Mean of each channel of z sign + bias, and the norm, from each point's sums of z."""
    total, square = (
        jnp.matmul(valid, part, precision=_HIGHEST) / count for part in (sums, squares)
    )
    mean = total * sign + bias
    return mean, norm_of(mean, square - total * total, groups)
