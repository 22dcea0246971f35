"""The MLP and its maximum on a whole cloud at once, as accelerators like it.

There it waits for memory and not for arithmetic, so it is written for few passes over n k rows: the
raw channels lie in planes, so that what makes them reads and writes neighbors side by side; a
channel of ones carries the first bias into the product; and what the second and the third layer are
asked for, sums, sums of squares and the maximum, is found in one reading.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental.layout import Layout, with_layout_constraint
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from cfr_jax.networks.layers import Layer, Norm, fold, norm_of

_WRITTEN_OUT = 64  # neighbors; a longer sum would make a program that is long to compile


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
    raw = with_layout_constraint(raw, Layout((2, 0, 1)))
    count = jnp.maximum(jnp.sum(valid) * raw.shape[1], 1)

    mean, covariance = _moments_of_raw(raw, valid, count)
    spread = ((covariance @ one.kernel) * one.kernel).sum(0)
    norm_one = norm_of(mean @ one.kernel + one.bias, spread, groups)
    kernel_one, bias_one = fold(one, norm_one)
    x = jnp.pad(raw, ((0, 0), (0, 0), (0, 1)), constant_values=1).astype(stored)
    y_one = jax.nn.relu(x @ jnp.vstack([kernel_one, bias_one]).astype(stored))
    # otherwise the product would be made again wherever it is read
    y_one = lax.optimization_barrier(y_one)

    z_two = y_one @ two.kernel.astype(stored)
    sums, squares, _ = _over_neighbors(z_two, raw.dtype)
    mean_two, norm_two = _norm(sums, squares, valid, count, two.bias, groups)
    gain = two.scale * norm_two.rate
    level = (two.bias - norm_two.mean) * gain + two.shift
    y_two = jax.nn.relu(z_two.astype(raw.dtype) * gain + level).astype(stored)

    # under a negative scale the smallest value becomes the largest
    sign = jnp.where(three.scale >= 0, 1, -1).astype(raw.dtype)
    z_three = y_two @ (three.kernel * sign).astype(stored)
    sums, squares, high = _over_neighbors(z_three, raw.dtype)
    mean_three, norm_three = _norm(sums * sign, squares, valid, count, three.bias, groups)
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


def _moments_of_raw(raw: Array, valid: Array, count: Array) -> tuple[Array, Array]:
    """Mean and covariance of the raw channels. Summed, not multiplied: a product of so few columns
    leaves a GPU's units empty, and would be rounded there."""

    def mean_of(planes: Array) -> Array:
        return jnp.sum(planes * valid[:, None], (1, 2)) / count

    planes = jnp.moveaxis(raw, -1, 0)
    mean = mean_of(planes)
    centered = planes - mean[:, None, None]
    row, column = np.triu_indices(len(planes))
    sums = mean_of(centered[row] * centered[column])
    place = np.zeros((len(planes), len(planes)), np.int32)
    place[row, column] = place[column, row] = np.arange(len(row))
    return mean, sums[place]


def _over_neighbors(z: Array, dtype: DTypeLike) -> tuple[Array, Array, Array]:
    """Sums, sums of squares and the largest value over each point's neighbors, (n, d) each.

    Written out as sums of slices, which XLA fuses into one kernel that reads z once; of three
    reductions of columns it makes three. The barrier keeps it from looking through z's shape.
    """
    z = lax.optimization_barrier(with_layout_constraint(z, Layout((0, 1, 2)))).astype(dtype)
    k = z.shape[1]
    if k > _WRITTEN_OUT:
        return z.sum(1), (z * z).sum(1), z.max(1)
    first, *rest = (z[:, i] for i in range(k))
    sums, squares, high = first, first * first, first
    for each in rest:
        sums, squares, high = sums + each, squares + each * each, jnp.maximum(high, each)
    return lax.optimization_barrier((sums, squares, high))


def _norm(
    sums: Array, squares: Array, valid: Array, count: Array, bias: Array, groups: int
) -> tuple[Array, Norm]:
    """Mean of each channel with its bias, and the norm, from each point's sums."""
    total, square = (jnp.sum(part * valid[:, None], 0) / count for part in (sums, squares))
    mean = total + bias
    return mean, norm_of(mean, square - total * total, groups)
