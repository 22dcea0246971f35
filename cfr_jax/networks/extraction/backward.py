"""The gradient of the MLP and its maximum, in two passes over the same tiles, last layer first."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from cfr_jax.networks.extraction.forward import Intermediates
from cfr_jax.networks.extraction.tiles import Limits, cut, cut_rows, scan, tiling_of
from cfr_jax.networks.layers import Layer, fold, projections

_HIGHEST = lax.Precision.HIGHEST  # for the raw channels, as in `forward`


def backward(
    layers: tuple[Layer, Layer, Layer],
    raw: Float[Array, "n k c"],
    valid: Float[Array, " n"],
    kept: Intermediates,
    gradient: Float[Array, "n d"],
    *,
    groups: int,
    limits: Limits,
) -> tuple[tuple[Layer, Layer, Layer], Float[Array, "n k c"]]:
    """Gradients with respect to the layers and the raw channels."""
    one, two, three = layers
    (norm_one, norm_two, norm_three), normal, second = kept
    n, k, channels = raw.shape
    width = three.bias.size
    tiling = tiling_of(n, k, limits)
    tiles = cut_rows(raw, tiling)
    weights = jnp.repeat(cut(valid, tiling), k, axis=1)
    # only what fills whole tiles can be reused
    some = min(tiling.number, len(second) // tiles.shape[1])
    second = second[: some * tiles.shape[1]].reshape(some, tiles.shape[1], two.bias.size)
    rows = jnp.maximum(jnp.sum(valid) * k, 1)
    kernel_first, bias_first = fold(one, norm_one)

    def first(raw: Array) -> Array:
        return jax.nn.relu(raw @ kernel_first + bias_first)

    def again(raw: Array) -> Array:
        return first(raw) @ two.kernel

    def normal_two(z: Array) -> Array:
        return (z + (two.bias - norm_two.mean)) * norm_two.rate

    # Third norm: only the extreme value of each point receives a gradient, so the projections are
    # sums over n.
    alive = normal * three.scale + three.shift > 0
    gradient = jnp.where(alive, gradient, 0) * valid[:, None]
    shift_three, scale_three = gradient.sum(0), (gradient * normal).sum(0)
    flat_three, tilt_three = projections(three, shift_three, scale_three, rows, groups)
    at_extreme = gradient * three.scale * norm_three.rate
    at_extreme = cut(at_extreme, tiling)

    def through_three(
        sums: tuple[Array, ...], z_two: Array, raw: Array, weight: Array, incoming: Array
    ) -> tuple[tuple[Array, ...], Array]:
        n_two = normal_two(z_two)
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
    (kernel_three, bias_three, shift_two, scale_two), d_two = scan(
        through_three, sums, second, again, tiles, weights, at_extreme
    )
    flat_two, tilt_two = projections(two, shift_two, scale_two, rows, groups)
    gain_one = one.kernel * (one.scale * norm_one.rate)

    def through_two(
        sums: tuple[Array, ...], z_two: Array, raw: Array, weight: Array, d_n: Array
    ) -> tuple[tuple[Array, ...], Array]:
        y_one = first(raw)
        dense = (flat_two + tilt_two * normal_two(z_two)) * weight[:, None]
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
    (kernel_two, bias_two, shift_one, outer), d_raw = scan(
        through_two, sums, second, again, tiles, weights, d_two
    )
    # First layer: its normalized output is linear in the raw channels, so the rest is linear too.
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
    return gradients, d_raw.reshape(raw.shape)
