"""The MLP and its maximum with activations in bfloat16: half the memory traffic on accelerators.

On a GPU the MLP is limited by memory, not by arithmetic. So this form processes a whole cloud at
once, stores the values of each layer once, in two bytes each, and recomputes nothing. Products take
bfloat16 inputs and accumulate in float32. The norms, their statistics, and the gradients of the
weights are float32.

The gradient is that of `backward`, with two differences. Ties at the maximum are frequent, because
bfloat16 has eight bits of precision; tied values share the gradient. And sums that follow from the
moments of the forward pass are not computed again.
"""

from __future__ import annotations

import functools

import jax.numpy as jnp
from jax.experimental.layout import Layout, with_layout_constraint
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from cfr_jax.networks.extraction.whole import Values, forward
from cfr_jax.networks.layers import Layer, Norm, projections
from cfr_jax.runtime.tracing.gradients import with_gradient

_Layers = tuple[Layer, Layer, Layer]


def pooled_mixed(
    layers: tuple[Layer, Layer, Layer],
    raw: Float[Array, "n k c"],
    valid: Float[Array, " n"],
    groups: int,
    stored: DTypeLike = jnp.bfloat16,
) -> Float[Array, "n d"]:
    """`extraction.pooled_features`, except that features of invalid points are not yet zero.

    `valid` is 1 for valid points and 0 for the others. `stored` is the type of the activations. The
    gradient has a rule of its own.
    """
    there = functools.partial(forward, groups=groups, stored=stored)
    back = functools.partial(_backward, groups, stored)
    return with_gradient(there, back, layers, raw, valid)


def _backward(
    groups: int,
    stored: DTypeLike,
    arguments: tuple[_Layers, Array, Array],
    values: Values,
    gradient: Array,
) -> tuple[_Layers, Array, None]:
    (one, two, three), raw, valid = arguments
    means, covariance, norms, normal, x, y_one, z_two, y_two, z_three = values
    mean, mean_two, mean_three = means
    norm_one, norm_two, norm_three = norms
    count = jnp.maximum(jnp.sum(valid) * raw.shape[1], 1)
    weight = valid[:, None, None]

    # Third layer: the maximum of each point receives the gradient; all other values receive only
    # what the norm takes out.
    gradient = jnp.where(normal * three.scale + three.shift > 0, gradient, 0) * valid[:, None]
    shift_three, scale_three = gradient.sum(0), (gradient * normal).sum(0)
    flat, tilt = projections(three, shift_three, scale_three, count, groups)
    sign = jnp.where(three.scale >= 0, 1, -1).astype(raw.dtype)
    at_extreme = gradient * three.scale * norm_three.rate
    chosen = z_three == z_three.max(1, keepdims=True)
    share = at_extreme / jnp.sum(chosen, axis=1, dtype=raw.dtype)
    slope, offset = _normalizing(norm_three, three.bias)
    n_three = z_three.astype(raw.dtype) * (sign * slope) + offset
    dense = (flat + tilt * n_three) * norm_three.rate
    d_z = (jnp.where(chosen, share[:, None], 0) - dense * weight).astype(stored)
    total = count * (flat + tilt * (mean_three - norm_three.mean) * norm_three.rate)
    bias_three = at_extreme.sum(0) - total * norm_three.rate
    kernel_three = _over_rows(y_two, d_z)
    d_y = d_z @ three.kernel.astype(stored).T

    # Second layer
    gain, level = _affine(two, norm_two)
    slope, offset = _normalizing(norm_two, two.bias)
    z = z_two.astype(raw.dtype)
    n_two = z * slope + offset
    d_n = jnp.where(z * gain + level > 0, d_y.astype(raw.dtype), 0)
    shift_two, scale_two = _sum(d_n), _sum(d_n * n_two)
    flat, tilt = projections(two, shift_two, scale_two, count, groups)
    d_z = ((d_n * two.scale - (flat + tilt * n_two) * weight) * norm_two.rate).astype(stored)
    total = count * (flat + tilt * (mean_two - norm_two.mean) * norm_two.rate)
    bias_two = (shift_two * two.scale - total) * norm_two.rate
    kernel_two = _over_rows(y_one, d_z)
    d_y = d_z @ two.kernel.astype(stored).T

    # First layer: its normalized output is linear in the raw channels, so the rest is linear too.
    d_n = jnp.where(y_one > 0, d_y, 0)
    outer = _over_rows(x, d_n)
    outer, shift_one = outer[:-1], outer[-1]
    slope, offset = one.kernel * norm_one.rate, (one.bias - norm_one.mean) * norm_one.rate
    scale_one = (slope * outer).sum(0) + offset * shift_one
    flat, tilt = projections(one, shift_one, scale_one, count, groups)
    level, steep = flat + tilt * offset, slope * tilt
    gram = covariance + jnp.outer(mean, mean)
    kernel_one = outer * one.scale - count * (jnp.outer(mean, level) + gram @ steep)
    bias_one = shift_one * one.scale - count * (level + mean @ steep)
    d_raw = d_n.astype(raw.dtype) @ (one.kernel * (one.scale * norm_one.rate)).T
    d_raw = d_raw - (raw @ (steep @ slope.T) + level @ slope.T) * weight
    gradients = (
        Layer(kernel_one * norm_one.rate, bias_one * norm_one.rate, scale_one, shift_one),
        Layer(kernel_two, bias_two, scale_two, shift_two),
        Layer(kernel_three, bias_three, scale_three, shift_three),
    )
    return gradients, d_raw, None


def _sum(values: Array) -> Array:
    """The sum over points and neighbors; neighbors first, as they are adjacent in memory."""
    return with_layout_constraint(values, Layout((0, 1, 2))).sum((0, 1))


def _affine(layer: Layer, norm: Norm) -> tuple[Array, Array]:
    """The norm of z + bias with its scale and shift, as one gain and one level."""
    gain = layer.scale * norm.rate
    return gain, (layer.bias - norm.mean) * gain + layer.shift


def _normalizing(norm: Norm, bias: Array) -> tuple[Array, Array]:
    """The norm of z + bias as one slope and one offset."""
    return norm.rate, (bias - norm.mean) * norm.rate


def _over_rows(left: Array, right: Array) -> Array:
    """left' right over all rows, accumulated in float32."""
    left, right = (rows.reshape(-1, rows.shape[-1]) for rows in (left, right))
    return jnp.matmul(left.T, right, preferred_element_type=jnp.float32)
