"""The learned modules: heavy features once, light layers per iteration, annealing in one go.

Parameters of the L iterations are stacked on a leading axis. Shapes below: n, m points of a cloud,
k neighbors, d = 96 channels, L iterations.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cfr_jax.networks.annealing import AnnealingNet
from cfr_jax.networks.extraction import Activations, pooled_features
from cfr_jax.networks.layers import GROUPS, Layer, group_norm, kernel_init, unit_rows
from cfr_jax.networks.record import Params

CHANNELS = 96
RAW_CHANNELS = 7

# As `kernel_init`, for parameters that are stacked on a leading axis.
_stacked_init = nn.initializers.variance_scaling(1 / 3, "fan_in", "uniform", batch_axis=(0,))


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

    def setup(self) -> None:
        count, d = 1 if self.shared else self.iterations, CHANNELS
        self.position: Array = self.param("position", _stacked_init, (count, 3, d))
        self.scale: Array = self.param("scale", nn.initializers.ones, (count, d))
        self.shift: Array = self.param("shift", nn.initializers.zeros, (count, d))
        self.kernel: Array = self.param("kernel", _stacked_init, (count, d, d))
        self.bias: Array = self.param("bias", nn.initializers.zeros, (count, d))

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


class CFR(nn.Module):
    """Cascading feature extraction: the three learned parts under one roof."""

    iterations: int = 5
    shared: bool = False

    def setup(self) -> None:
        self.features: PointFeatures = PointFeatures()
        self.cascade: Cascade = Cascade(self.iterations, self.shared)
        self.annealing: AnnealingNet = AnnealingNet(self.iterations)

    def __call__(self, raw: Array, source: Array, target: Array) -> object:
        """Touches every part once, so that `init` makes all parameters."""
        features = self.features(raw)
        return self.cascade.at_rest(features, source), self.annealing(source, target)


def init_params(key: jax.Array, iterations: int = 5, shared: bool = False) -> Params:
    """Fresh parameters, a pytree of float32 arrays; `shared`: one light layer for all of them."""
    points, raw = jnp.zeros((2, 3)), jnp.zeros((2, 1, RAW_CHANNELS))
    return CFR(iterations, shared).init(key, raw, points, points)["params"]
