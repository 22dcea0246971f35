"""The annealing network, which CFR and RPM-Net share: it decides how sharp each match is.

Shapes below: n, m points of the clouds, L iterations.
"""

from __future__ import annotations

from typing import NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from cfr_jax.networks.layers import GROUPS, apply_layer, kernel_init, layer_of
from cfr_jax.networks.pooling import pooled_layer

# The name of each layer in both authors' checkpoints, and of its weight and bias here.
AUTHORS_LAYERS = (
    ("weights_net.prepool.0", "annealing/point_0_dense/kernel", "annealing/point_0_dense/bias"),
    ("weights_net.prepool.1", "annealing/point_0_scale", "annealing/point_0_shift"),
    ("weights_net.prepool.3", "annealing/point_1_dense/kernel", "annealing/point_1_dense/bias"),
    ("weights_net.prepool.4", "annealing/point_1_scale", "annealing/point_1_shift"),
    ("weights_net.prepool.6", "annealing/point_2_dense/kernel", "annealing/point_2_dense/bias"),
    ("weights_net.prepool.7", "annealing/point_2_scale", "annealing/point_2_shift"),
    ("weights_net.prepool.9", "annealing/point_3_dense/kernel", "annealing/point_3_dense/bias"),
    ("weights_net.prepool.10", "annealing/point_3_scale", "annealing/point_3_shift"),
    ("weights_net.prepool.12", "annealing/point_4_dense/kernel", "annealing/point_4_dense/bias"),
    ("weights_net.prepool.13", "annealing/point_4_scale", "annealing/point_4_shift"),
    ("weights_net.postpool.0", "annealing/pair_0_dense/kernel", "annealing/pair_0_dense/bias"),
    ("weights_net.postpool.1", "annealing/pair_0_scale", "annealing/pair_0_shift"),
    ("weights_net.postpool.3", "annealing/pair_1_dense/kernel", "annealing/pair_1_dense/bias"),
    ("weights_net.postpool.4", "annealing/pair_1_scale", "annealing/pair_1_shift"),
    ("weights_net.postpool.6", "annealing/out/kernel", "annealing/out/bias"),
)


class Annealing(NamedTuple):
    """The annealing parameters: per iteration, how sharp (beta) and how far-reaching (alpha) the
    match is."""

    beta: Float[Array, " L"]
    alpha: Float[Array, " L"]


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


def _join_masks(
    source: Array, target: Array, source_mask: Array | None, target_mask: Array | None
) -> Array | None:
    if source_mask is None and target_mask is None:
        return None
    masks = [
        jnp.ones(cloud.shape[0], bool) if mask is None else mask
        for cloud, mask in ((source, source_mask), (target, target_mask))
    ]
    return jnp.concatenate(masks)
