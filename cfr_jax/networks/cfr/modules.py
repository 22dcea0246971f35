"""The learned modules: heavy features once, light layers per iteration, annealing in one go.

Parameters of the L iterations are stacked on a leading axis. Shapes below: n, m points of a cloud,
k neighbors, d = 96 channels, L iterations.
"""

from __future__ import annotations

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from cfr_jax.networks.extraction import Activations, pooled_features
from cfr_jax.networks.layers import Layer, apply_layer, group_norm
from cfr_jax.networks.pooling import pooled_layer

CHANNELS = 96
GROUPS = 8
RAW_CHANNELS = 7

# What PyTorch's Linear starts from, as the published networks did.
kernel_init = nn.initializers.variance_scaling(1 / 3, "fan_in", "uniform")
_stacked_init = nn.initializers.variance_scaling(1 / 3, "fan_in", "uniform", batch_axis=(0,))


class Annealing(NamedTuple):
    """How sharp (beta) and how far-reaching (alpha) the match of each iteration is."""

    beta: Float[Array, " L"]
    alpha: Float[Array, " L"]


class PointFeatures(nn.Module):
    """The heavy extraction: an MLP on every neighbor of every point, then the maximum."""

    @nn.compact
    def __call__(
        self,
        raw: Float[Array, "n k c"],
        mask: Bool[Array, " n"] | None = None,
        activations: Activations = "float32",
    ) -> Float[Array, "n d"]:
        layers, width = [], raw.shape[-1]
        for i in range(3):
            layers.append(
                Layer(
                    kernel=self.param(f"kernel_{i}", kernel_init, (width, CHANNELS)),
                    bias=self.param(f"bias_{i}", nn.initializers.zeros, (CHANNELS,)),
                    scale=self.param(f"scale_{i}", nn.initializers.ones, (CHANNELS,)),
                    shift=self.param(f"shift_{i}", nn.initializers.zeros, (CHANNELS,)),
                )
            )
            width = CHANNELS
        return pooled_features(
            tuple(layers), raw, groups=GROUPS, mask=mask, activations=activations
        )


class Cascade(nn.Module):
    """The light layers (QMLP), one per iteration, each with parameters of its own, or one `shared`
    by all of them.

    Layer i turns the features that layer i - 1 left, and where the points are now, into features to
    match: f <- normalize(A relu(groupnorm(f + B x)) + a).
    """

    iterations: int
    shared: bool = False

    def setup(self):
        count, d = 1 if self.shared else self.iterations, CHANNELS
        self.position = self.param("position", _stacked_init, (count, 3, d))
        self.scale = self.param("scale", nn.initializers.ones, (count, d))
        self.shift = self.param("shift", nn.initializers.zeros, (count, d))
        self.kernel = self.param("kernel", _stacked_init, (count, d, d))
        self.bias = self.param("bias", nn.initializers.zeros, (count, d))

    def layer(
        self,
        i: int,
        features: Float[Array, "n d"],
        points: Float[Array, "n 3"],
        mask: Bool[Array, " n"] | None = None,
    ) -> Float[Array, "n d"]:
        """Layer `i` (from 0) alone; unit rows."""
        i = 0 if self.shared else i
        moved = features + points @ self.position[i]
        hidden = nn.relu(group_norm(moved, self.scale[i], self.shift[i], groups=GROUPS, mask=mask))
        return unit_rows(hidden @ self.kernel[i] + self.bias[i])

    def at_rest(
        self,
        features: Float[Array, "n d"],
        points: Float[Array, "n 3"],
        mask: Bool[Array, " n"] | None = None,
    ) -> Float[Array, "L n d"]:
        """All layers in a row for a cloud that does not move: the reference."""
        every = []
        for i in range(self.iterations):
            features = self.layer(i, features, points, mask)
            every.append(features)
        return jnp.stack(every)


class AnnealingNet(nn.Module):
    """A PointNet on both clouds that gives the annealing parameters of all iterations at once."""

    iterations: int

    @nn.compact
    def __call__(
        self,
        source: Float[Array, "n 3"],
        target: Float[Array, "m 3"],
        source_mask: Bool[Array, " n"] | None = None,
        target_mask: Bool[Array, " m"] | None = None,
    ) -> Annealing:
        flagged = [
            jnp.pad(source, ((0, 0), (0, 1))),
            jnp.pad(target, ((0, 0), (0, 1)), constant_values=1),
        ]
        x = jnp.concatenate(flagged)
        mask = _join_masks(source, target, source_mask, target_mask)
        for i, width in enumerate((64, 64, 64, 128)):
            x = nn.relu(
                apply_layer(
                    layer_of(self, f"point_{i}", x.shape[-1], width), x, groups=GROUPS, mask=mask
                )
            )
        x = pooled_layer(
            layer_of(self, "point_4", x.shape[-1], 1024), x, groups=2 * GROUPS, mask=mask
        )[None]
        for i, width in enumerate((512, 256)):
            x = nn.relu(
                apply_layer(layer_of(self, f"pair_{i}", x.shape[-1], width), x, groups=2 * GROUPS)
            )
        x = nn.softplus(nn.Dense(2 * self.iterations, kernel_init=kernel_init, name="out")(x)[0])
        return Annealing(beta=x[: self.iterations], alpha=x[self.iterations :])


def layer_of(module: nn.Module, name: str, inputs: int, width: int) -> Layer:
    """The parameters of a Linear and its GroupNorm, as `name` in a module under construction."""
    kernel, bias = _Linear(width, name=f"{name}_dense")(inputs)
    scale = module.param(f"{name}_scale", nn.initializers.ones, (width,))
    shift = module.param(f"{name}_shift", nn.initializers.zeros, (width,))
    return Layer(kernel, bias, scale, shift)


class _Linear(nn.Module):
    """The parameters of a Dense, for those who apply them in their own way."""

    width: int

    @nn.compact
    def __call__(self, inputs: int):
        kernel = self.param("kernel", kernel_init, (inputs, self.width))
        return kernel, self.param("bias", nn.initializers.zeros, (self.width,))


class CFR(nn.Module):
    """Cascading feature extraction: the three learned parts under one roof."""

    iterations: int = 5
    shared: bool = False

    def setup(self):
        self.features = PointFeatures()
        self.cascade = Cascade(self.iterations, self.shared)
        self.annealing = AnnealingNet(self.iterations)

    def __call__(self, raw, source, target):
        """Touches every part once, so that `init` makes all parameters."""
        features = self.features(raw)
        return self.cascade.at_rest(features, source), self.annealing(source, target)


def unit_rows(x: Float[Array, "n c"]) -> Float[Array, "n c"]:
    """Rows scaled to length one; a row shorter than 1e-12 becomes zero, with zero gradient."""
    square = jnp.sum(x * x, axis=-1, keepdims=True)
    positive = square > 1e-24  # below, the cube in the derivative would overflow
    return jnp.where(positive, x * lax.rsqrt(jnp.where(positive, square, 1)), 0)


def _join_masks(source, target, source_mask, target_mask):
    if source_mask is None and target_mask is None:
        return None
    masks = [
        jnp.ones(cloud.shape[0], bool) if mask is None else mask
        for cloud, mask in ((source, source_mask), (target, target_mask))
    ]
    return jnp.concatenate(masks)


def init_params(key: jax.Array, iterations: int = 5, shared: bool = False) -> dict:
    """Fresh parameters, a pytree of float32 arrays; `shared`: one light layer for all of them."""
    points, raw = jnp.zeros((2, 3)), jnp.zeros((2, 1, RAW_CHANNELS))
    return CFR(iterations, shared).init(key, raw, points, points)["params"]
