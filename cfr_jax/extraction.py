"""The heavy part: a shared MLP on every neighbor of every point, pooled by maximum.

Three layers of Linear, GroupNorm and ReLU see n k rows per cloud, and the norm's statistics run
over all of them, so the plain form writes and reads n k 96 floats eight times, and four times that
for its gradient. Here no activation of that size is ever stored: tiles of points stay in a cache.

- The first layer's statistics follow exactly from the mean and covariance of the seven raw
  channels.
- One pass over the tiles sums the second layer's output for its statistics.
- A second pass, the first two norms folded into their weights, sums the third layer's output and
  keeps its largest value over the neighbors. The norm and the ReLU are monotonic per channel, so
  the pooled feature is that value, normalized. (Where the norm's scale is negative it is the
  smallest value: the sign is folded into the weights.)

The gradient is written out for the same reason. Through a norm it is the incoming gradient minus
its projections on 1 and on the normalized values, and both projections are sums over rows: the last
layer's follow from the pooled values alone, the first layer's from sums of seven channels.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from cfr_jax.batching import cloud_by_cloud
from cfr_jax.layers import Layer, fold, norm_of, projections

_HIGHEST = lax.Precision.HIGHEST  # for what becomes a variance, and for the raw channels
# Rows of 96 floats in flight, so that a tile's activations stay in a cache: two or three of them at
# a time forward, about eight backward.
_FORWARD_ROWS = 8192
_BACKWARD_ROWS = 4096


def pooled_features(
    layers: tuple[Layer, Layer, Layer],
    raw: Float[Array, "n k c"],
    *,
    groups: int,
    mask: Bool[Array, " n"] | None = None,
) -> Float[Array, "n d"]:
    """Per-neighbor MLP and maximum over the neighbors, one feature per point.

    Rows of masked points enter no statistic; their own features are zero. Differentiates by its own
    rule, once, with memory for one tile.
    """
    n = raw.shape[0]
    valid = jnp.ones(n, raw.dtype) if mask is None else mask.astype(raw.dtype)
    return _pooled(layers, raw, valid, groups) * valid[:, None]


@functools.partial(jax.custom_vjp, nondiff_argnums=(3,))
def _pooled(layers, raw, valid, groups):
    return cloud_by_cloud(functools.partial(_forward, groups=groups))(layers, raw, valid)[0]


def _pooled_fwd(layers, raw, valid, groups):
    forward = cloud_by_cloud(functools.partial(_forward, groups=groups))
    pooled, norms, normal = forward(layers, raw, valid)
    return pooled, (layers, raw, valid, norms, normal)


def _pooled_bwd(groups, residuals, gradient):
    return cloud_by_cloud(functools.partial(_backward, groups=groups))(residuals, gradient)


_pooled.defvjp(_pooled_fwd, _pooled_bwd)


def _forward(layers, raw, valid, *, groups):
    one, two, three = layers
    n, k, _ = raw.shape
    count = -(-n * k // _FORWARD_ROWS)
    tiles = _cut(raw, count).reshape(count, -1, raw.shape[-1])
    rows = jnp.maximum(jnp.sum(valid) * k, 1)

    norm_one = norm_of(*_moments_of_first(one, tiles, valid, rows), groups)
    kernel_one, bias_one = fold(one, norm_one)

    # Both passes leave sums per point, and the mask weighs them afterwards: reductions that follow
    # a product directly are fused into it on CPU, and its output is never written.
    def statistics(_, raw):
        z = jax.nn.relu(raw @ kernel_one + bias_one) @ two.kernel
        return None, _sums_of_neighbors(z, k)

    _, sums = lax.scan(statistics, None, tiles)
    norm_two = norm_of(*_moments(sums, valid, rows, two.bias), groups)
    kernel_two, bias_two = fold(two, norm_two)

    # under a negative scale the smallest value becomes the largest
    sign = jnp.where(three.scale >= 0, 1, -1).astype(raw.dtype)
    kernel_three = three.kernel * sign

    def extremes(_, raw):
        y = jax.nn.relu(raw @ kernel_one + bias_one)
        z = jax.nn.relu(y @ kernel_two + bias_two) @ kernel_three
        return None, (_sums_of_neighbors(z, k), z.reshape(-1, k, z.shape[-1]).max(1))

    _, (sums, high) = lax.scan(extremes, None, tiles)
    norm_three = norm_of(*_moments(sums, valid, rows, three.bias, sign), groups)
    extreme = high.reshape(-1, high.shape[-1])[:n] * sign + three.bias
    normal = (extreme - norm_three.mean) * norm_three.rate
    pooled = jax.nn.relu(normal * three.scale + three.shift)
    return pooled, (norm_one, norm_two, norm_three), normal


def _backward(residuals, gradient, *, groups):
    layers, raw, valid, (norm_one, norm_two, norm_three), normal = residuals
    one, two, three = layers
    n, k, channels = raw.shape
    width = three.bias.size
    count = -(-n * k // _BACKWARD_ROWS)
    tiles = _cut(raw, count).reshape(count, -1, channels)
    weights = jnp.repeat(_cut(valid, count), k, axis=1)
    rows = jnp.maximum(jnp.sum(valid) * k, 1)
    kernel_first, bias_first = fold(one, norm_one)

    # Third norm: only the extreme of each point receives gradient, so its projections are sums over
    # n.
    alive = normal * three.scale + three.shift > 0
    gradient = jnp.where(alive, gradient, 0) * valid[:, None]
    shift_three, scale_three = gradient.sum(0), (gradient * normal).sum(0)
    flat_three, tilt_three = projections(three, shift_three, scale_three, rows, groups)
    at_extreme = gradient * three.scale * norm_three.rate
    at_extreme = _cut(at_extreme, count)

    def through_three(sums, tile):
        raw, weight, incoming = tile
        y_one = jax.nn.relu(raw @ kernel_first + bias_first)
        z_two = y_one @ two.kernel + two.bias
        n_two = (z_two - norm_two.mean) * norm_two.rate
        y_two = jax.nn.relu(n_two * two.scale + two.shift)
        z = y_two @ three.kernel + three.bias
        signed = (z * jnp.where(three.scale >= 0, 1, -1)).reshape(-1, k, width)
        chosen = signed == signed.max(1, keepdims=True)
        share = incoming / jnp.sum(chosen, axis=1, dtype=incoming.dtype)
        sparse = jnp.where(chosen, share[:, None], 0).reshape(z.shape)
        dense = flat_three + tilt_three * ((z - norm_three.mean) * norm_three.rate)
        d_z = sparse - dense * norm_three.rate * weight[:, None]
        d_n = jnp.where(y_two > 0, d_z @ three.kernel.T, 0)
        d_kernel, d_bias, shift, scale = sums
        sums = (
            d_kernel + y_two.T @ d_z,
            d_bias + d_z.sum(0),
            shift + d_n.sum(0),
            scale + (d_n * n_two).sum(0),
        )
        return sums, d_n

    zeros_of = [jax.tree.map(jnp.zeros_like, layer) for layer in layers]
    sums = (zeros_of[2].kernel, zeros_of[2].bias, zeros_of[1].bias, zeros_of[1].bias)
    (kernel_three, bias_three, shift_two, scale_two), d_two = lax.scan(
        through_three, sums, (tiles, weights, at_extreme)
    )
    flat_two, tilt_two = projections(two, shift_two, scale_two, rows, groups)
    gain_one = one.kernel * (one.scale * norm_one.rate)

    def through_two(sums, tile):
        raw, weight, d_n = tile
        y_one = jax.nn.relu(raw @ kernel_first + bias_first)
        n_two = (y_one @ two.kernel + (two.bias - norm_two.mean)) * norm_two.rate
        dense = (flat_two + tilt_two * n_two) * weight[:, None]
        d_z = (d_n * two.scale - dense) * norm_two.rate
        d_y = jnp.where(y_one > 0, d_z @ two.kernel.T, 0)
        d_kernel, d_bias, shift, outer = sums
        sums = (
            d_kernel + y_one.T @ d_z,
            d_bias + d_z.sum(0),
            shift + d_y.sum(0),
            outer + raw.T @ d_y,
        )
        return sums, d_y @ gain_one.T

    sums = (zeros_of[1].kernel, zeros_of[1].bias, zeros_of[0].bias, zeros_of[0].kernel)
    (kernel_two, bias_two, shift_one, outer), d_raw = lax.scan(
        through_two, sums, (tiles, weights, d_two)
    )
    # First layer: its normalized output is linear in the raw channels, and so is all that remains.
    slope, offset = one.kernel * norm_one.rate, (one.bias - norm_one.mean) * norm_one.rate
    scale_one = (slope * outer).sum(0) + offset * shift_one
    flat_one, tilt_one = projections(one, shift_one, scale_one, rows, groups)
    flat_raw = raw.reshape(-1, channels)
    weight = jnp.repeat(valid, k)[:, None]
    total = (weight * flat_raw).sum(0)
    gram = jnp.matmul((weight * flat_raw).T, flat_raw, precision=_HIGHEST)
    dense_outer = jnp.outer(total, flat_one + tilt_one * offset) + gram @ (slope * tilt_one)
    kernel_one = (outer * one.scale - dense_outer) * norm_one.rate
    dense_sum = rows * (flat_one + tilt_one * offset) + total @ (slope * tilt_one)
    bias_one = (shift_one * one.scale - dense_sum) * norm_one.rate
    pull = (slope * tilt_one) @ slope.T, (flat_one + tilt_one * offset) @ slope.T
    pulled = jnp.matmul(flat_raw, pull[0], precision=_HIGHEST) + pull[1]
    d_raw = d_raw.reshape(-1, channels)[: n * k] - pulled * weight
    gradients = (
        Layer(kernel_one, bias_one, scale_one, shift_one),
        Layer(kernel_two, bias_two, scale_two, shift_two),
        Layer(kernel_three, bias_three, scale_three, shift_three),
    )
    return gradients, d_raw.reshape(raw.shape), jnp.zeros_like(valid)


def _cut(values, count):
    """Points cut into `count` tiles, padded to whole ones: (count, size, ...)."""
    n = values.shape[0]
    size = -(-n // count)
    pad = [(0, count * size - n)] + [(0, 0)] * (values.ndim - 1)
    return jnp.pad(values, pad).reshape(count, size, *values.shape[1:])


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
    weights = _cut(valid, count)
    each = tiles.reshape(*weights.shape, -1, channels)
    mean = jnp.sum(weights[:, :, None, None] * each, (0, 1, 2)) / rows

    def add(gram, tile):
        raw, weight = tile
        centered = ((raw - mean) * weight[:, None, None]).reshape(-1, channels)
        return gram + jnp.matmul(centered.T, centered, precision=_HIGHEST), None

    gram, _ = lax.scan(add, jnp.zeros((channels, channels), tiles.dtype), (each, weights))
    covariance = gram / rows
    return mean @ layer.kernel + layer.bias, ((covariance @ layer.kernel) * layer.kernel).sum(0)
