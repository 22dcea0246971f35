"""The learned modules: heavy features once, light layers per iteration, annealing all at once.

The parameters of the L iterations are stacked along a leading axis. Shapes below: n, m points of
the clouds, k neighbors, d = 96 channels, L iterations.
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

# Like `kernel_init`, for parameters stacked along a leading axis.
_stacked_init = nn.initializers.variance_scaling(1 / 3, "fan_in", "uniform", batch_axis=(0,))


class PointFeatures(nn.Module):
    """The heavy extraction: an MLP on every neighbor of every point, then the maximum."""

    @nn.compact
    def __call__(
        self,
        raw: Float[Array, "n k c"],
        mask: Bool[Array, " n"] | None = None,
        activations: Activations = "float32",
        columns: Bool[Array, " k"] | None = None,
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
            tuple(layers),
            raw,
            groups=GROUPS,
            mask=mask,
            columns=columns,
            activations=activations,
        )


class Cascade(nn.Module):
    """The light layers (QMLP): one per iteration with its own parameters, or one `shared` by all.

    Layer i takes the features from layer i - 1 and the current positions x of the points, and
    returns the features to match: f <- normalize(A relu(groupnorm(f + B x)) + a).
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
        """Layer `i` (from 0) alone; the rows of the result have length one."""
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
        """All layers, one after the other, for a cloud that does not move: the target."""
        every = []
        for i in range(self.iterations):
            features = self.layer(i, features, points, mask)
            every.append(features)
        return jnp.stack(every)


class CFR(nn.Module):
    """Cascading feature extraction: the three learned parts in one module."""

    iterations: int = 5
    shared: bool = False

    def setup(self) -> None:
        self.features: PointFeatures = PointFeatures()
        self.cascade: Cascade = Cascade(self.iterations, self.shared)
        self.annealing: AnnealingNet = AnnealingNet(self.iterations)

    def __call__(self, raw: Array, source: Array, target: Array) -> object:
        """Runs every part once, so that `init` makes all parameters."""
        features = self.features(raw)
        return self.cascade.at_rest(features, source), self.annealing(source, target)


def init_params(key: jax.Array, iterations: int = 5, shared: bool = False) -> Params:
    """Fresh parameters, a pytree of float32 arrays; if `shared`, with only one light layer."""
    points, raw = jnp.zeros((2, 3)), jnp.zeros((2, 1, RAW_CHANNELS))
    return CFR(iterations, shared).init(key, raw, points, points)["params"]
