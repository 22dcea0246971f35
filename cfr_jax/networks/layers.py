"""Linear, then GroupNorm: the layer that all networks here are made of.

GroupNorm (Wu & He, 2018) runs over all rows of one cloud: each group of channels is normalized to
mean zero and variance one. Flax's GroupNorm does not fit: it treats the first axis as a batch and
has no mask over rows.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

EPSILON = 1e-5
GROUPS = 8  # groups of channels in most layers of the published networks

# How PyTorch's Linear is initialized, and with it the published networks.
kernel_init: Final = nn.initializers.variance_scaling(1 / 3, "fan_in", "uniform")


class Layer(NamedTuple):
    """Parameters of a Linear and of the GroupNorm after it; every leaf may carry gradients."""

    kernel: Float[Array, "i o"]
    bias: Float[Array, " o"]
    scale: Float[Array, " o"]
    shift: Float[Array, " o"]


class Norm(NamedTuple):
    """The statistics of a GroupNorm, per channel: normalized = (z - mean) * rate."""

    mean: Float[Array, " o"]
    rate: Float[Array, " o"]


def group_norm(
    x: Float[Array, "n c"],
    scale: Float[Array, " c"],
    shift: Float[Array, " c"],
    *,
    groups: int,
    mask: Bool[Array, " n"] | None = None,
) -> Float[Array, "n c"]:
    """GroupNorm of one cloud; rows where `mask` is false do not affect the statistics."""
    # Sum over the rows first, channel by channel, then over the channels of a group: this works on
    # vectors as wide as x instead of as narrow as a group.
    size = x.shape[1] // groups
    valid = None if mask is None else mask[:, None].astype(x.dtype)
    count = jnp.asarray(x.shape[0], x.dtype) if valid is None else jnp.maximum(jnp.sum(valid), 1)

    def mean_of_group(rows: Array) -> Array:
        total = jnp.sum(rows if valid is None else rows * valid, axis=0)
        return jnp.repeat(total.reshape(groups, size).mean(1) / count, size)

    centered = x - mean_of_group(x)
    variance = mean_of_group(centered * centered)
    return centered * (lax.rsqrt(variance + EPSILON) * scale) + shift


def apply_layer(
    layer: Layer,
    x: Float[Array, "n i"],
    *,
    groups: int,
    mask: Bool[Array, " n"] | None = None,
) -> Float[Array, "n o"]:
    """Linear, then GroupNorm."""
    z = x @ layer.kernel + layer.bias
    return group_norm(z, layer.scale, layer.shift, groups=groups, mask=mask)


def norm_of(mean: Float[Array, " o"], variance: Float[Array, " o"], groups: int) -> Norm:
    """The norm from each channel's mean and variance, which are pooled over each group."""
    means = mean.reshape(groups, -1)
    joined = means.mean(1, keepdims=True)
    spread = ((means - joined) ** 2).mean(1) + variance.reshape(groups, -1).mean(1)
    size = mean.size // groups
    rate = lax.rsqrt(jnp.maximum(spread, 0) + EPSILON)
    return Norm(jnp.repeat(joined[:, 0], size), jnp.repeat(rate, size))


def fold(layer: Layer, norm: Norm) -> tuple[Float[Array, "i o"], Float[Array, " o"]]:
    """The layer and its norm as one affine map."""
    gain = layer.scale * norm.rate
    return layer.kernel * gain, (layer.bias - norm.mean) * gain + layer.shift


def projections(
    layer: Layer, shift: Float[Array, " o"], scale: Float[Array, " o"], rows: Array, groups: int
) -> tuple[Float[Array, " o"], Float[Array, " o"]]:
    """What a norm takes out of the incoming gradient, from the gradients of `shift` and `scale`.

    First its mean over the rows and channels of the group, then its mean along the normalized
    values. `rows` is the number of rows in the statistics.
    """
    size = shift.size // groups
    flat, tilt = (
        jnp.repeat((layer.scale * s).reshape(groups, size).sum(1), size) / (rows * size)
        for s in (shift, scale)
    )
    return flat, tilt


def layer_of(module: nn.Module, name: str, inputs: int, width: int) -> Layer:
    """Declares the parameters of a Linear and its GroupNorm in `module`, under `name`."""
    kernel, bias = _Linear(width, name=f"{name}_dense")(inputs)
    scale = module.param(f"{name}_scale", nn.initializers.ones, (width,))
    shift = module.param(f"{name}_shift", nn.initializers.zeros, (width,))
    return Layer(kernel, bias, scale, shift)


class _Linear(nn.Module):
    """The parameters of a Dense layer, without applying them."""

    width: int

    @nn.compact
    def __call__(self, inputs: int) -> tuple[Array, Array]:
        kernel = self.param("kernel", kernel_init, (inputs, self.width))
        return kernel, self.param("bias", nn.initializers.zeros, (self.width,))


def unit_rows(x: Float[Array, "n c"]) -> Float[Array, "n c"]:
    """Rows scaled to length one; a row shorter than 1e-12 becomes zero, with zero gradient."""
    square = jnp.sum(x * x, axis=-1, keepdims=True)
    positive = square > 1e-24  # below, the cube in the derivative would overflow
    return jnp.where(positive, x * lax.rsqrt(jnp.where(positive, square, 1)), 0)
