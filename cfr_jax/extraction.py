"""The heavy part: a shared MLP on every neighbor of every point, pooled by maximum.

Three layers of Linear, GroupNorm and ReLU see n k rows per cloud, and the norm's statistics run
over all of them, so the plain form writes and reads n k 96 floats eight times, and four times that
for its gradient. Here no activation of that size is ever stored: tiles of points stay in a core's
cache.

- The first layer's statistics follow exactly from the mean and covariance of the seven raw
  channels.
- One pass over the tiles sums the second layer's output for its statistics.
- A second pass, the first two norms folded into their weights, sums the third layer's output and
  keeps its largest and smallest value over the neighbors. The norm and the ReLU are monotonic per
  channel, so the pooled feature is one of these two, normalized.

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

from cfr_jax.layers import Layer, fold, norm_of, projections

_TILE_ROWS = 4096  # rows of 96 floats: 1.5 MB, the activations of one tile in a core's cache


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
    return _forward(layers, raw, valid, groups)[0]


def _forward(layers, raw, valid, groups):
    one, two, three = layers
    n, k, channels = raw.shape
    tiles, weights = _tiles(raw, valid)
    rows = jnp.maximum(jnp.sum(valid) * k, 1)

    norm_one = norm_of(*_moments_of_first(one, raw, valid, rows), groups)
    kernel_one, bias_one = fold(one, norm_one)

    def statistics(sums, tile):
        raw, weight = tile
        z = jax.nn.relu(raw @ kernel_one + bias_one) @ two.kernel
        return _add_sums(sums, z, weight), None

    zeros = jnp.zeros((2, two.bias.size), raw.dtype)
    sums, _ = lax.scan(statistics, zeros, (tiles, weights))
    norm_two = norm_of(*_moments(sums, rows, two.bias), groups)
    kernel_two, bias_two = fold(two, norm_two)

    def extremes(sums, tile):
        raw, weight = tile
        y = jax.nn.relu(raw @ kernel_one + bias_one)
        z = jax.nn.relu(y @ kernel_two + bias_two) @ three.kernel
        each = z.reshape(-1, k, z.shape[-1])
        return _add_sums(sums, z, weight), (each.max(1), each.min(1))

    zeros = jnp.zeros((2, three.bias.size), raw.dtype)
    sums, (high, low) = lax.scan(extremes, zeros, (tiles, weights))
    norm_three = norm_of(*_moments(sums, rows, three.bias), groups)
    high, low = (e.reshape(-1, e.shape[-1])[:n] + three.bias for e in (high, low))
    extreme = jnp.where(three.scale >= 0, high, low)
    normal = (extreme - norm_three.mean) * norm_three.rate
    pooled = jax.nn.relu(normal * three.scale + three.shift)
    return pooled, (layers, raw, valid, (norm_one, norm_two, norm_three), normal)


def _backward(groups, residuals, gradient):
    layers, raw, valid, (norm_one, norm_two, norm_three), normal = residuals
    one, two, three = layers
    n, k, channels = raw.shape
    width = three.bias.size
    tiles, weights = _tiles(raw, valid)
    rows = jnp.maximum(jnp.sum(valid) * k, 1)
    kernel_first, bias_first = fold(one, norm_one)

    # Third norm: only the extreme of each point receives gradient, so its projections are sums over
    # n.
    alive = normal * three.scale + three.shift > 0
    gradient = jnp.where(alive, gradient, 0) * valid[:, None]
    shift_three, scale_three = gradient.sum(0), (gradient * normal).sum(0)
    flat_three, tilt_three = projections(three, shift_three, scale_three, rows, groups)
    at_extreme = gradient * three.scale * norm_three.rate
    at_extreme = _cut(at_extreme, tiles.shape[0])

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
    total, gram = (weight * flat_raw).sum(0), (weight * flat_raw).T @ flat_raw
    dense_outer = jnp.outer(total, flat_one + tilt_one * offset) + gram @ (slope * tilt_one)
    kernel_one = (outer * one.scale - dense_outer) * norm_one.rate
    dense_sum = rows * (flat_one + tilt_one * offset) + total @ (slope * tilt_one)
    bias_one = (shift_one * one.scale - dense_sum) * norm_one.rate
    pull = (slope * tilt_one) @ slope.T, (flat_one + tilt_one * offset) @ slope.T
    d_raw = d_raw.reshape(-1, channels)[: n * k] - (flat_raw @ pull[0] + pull[1]) * weight
    gradients = (
        Layer(kernel_one, bias_one, scale_one, shift_one),
        Layer(kernel_two, bias_two, scale_two, shift_two),
        Layer(kernel_three, bias_three, scale_three, shift_three),
    )
    return gradients, d_raw.reshape(raw.shape), jnp.zeros_like(valid)


_pooled.defvjp(_forward, _backward)


def _tiles(raw, valid):
    """Points cut into tiles, padded to whole ones: (t, rows, c) values and (t, rows) weights."""
    n, k, c = raw.shape
    count = -(-n * k // _TILE_ROWS)
    weights = jnp.repeat(_cut(valid, count), k, axis=1)
    return _cut(raw, count).reshape(count, -1, c), weights


def _cut(values, count):
    n = values.shape[0]
    size = -(-n // count)
    pad = [(0, count * size - n)] + [(0, 0)] * (values.ndim - 1)
    return jnp.pad(values, pad).reshape(count, size, *values.shape[1:])


def _add_sums(sums, z, weight):
    return sums + jnp.stack([weight @ z, weight @ (z * z)])


def _moments(sums, rows, bias):
    mean = sums[0] / rows
    return mean + bias, sums[1] / rows - mean * mean


def _moments_of_first(layer, raw, valid, rows):
    weight = jnp.broadcast_to(valid[:, None, None], raw.shape[:2] + (1,))
    mean = (weight * raw).sum((0, 1)) / rows
    centered = (raw - mean) * weight
    covariance = jnp.einsum("nkc,nkd->cd", centered, centered) / rows
    return mean @ layer.kernel + layer.bias, ((covariance @ layer.kernel) * layer.kernel).sum(0)
