"""RPM-Net (Yew & Lee, CVPR 2020), the method that CFR starts from and is measured against.

Every iteration extracts the features of both clouds again, predicts its own annealing parameters
and normalizes in log space with five passes. `optimized` is the paper's RPMNet (Optim): log-free
Sinkhorn, and neighborhoods searched once (a rigid motion does not change them); same answers.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int32

from cfr_jax.geometry import rigid
from cfr_jax.geometry.neighbors import first_in_ball
from cfr_jax.networks.cfr.iterations import Step
from cfr_jax.networks.cfr.modules import GROUPS, AnnealingNet, kernel_init, layer_of, unit_rows
from cfr_jax.networks.extraction import pooled_features
from cfr_jax.networks.features import raw_features
from cfr_jax.networks.inputs import Cloud, moved_by
from cfr_jax.networks.layers import apply_layer
from cfr_jax.networks.sinkhorn import Affinity, match

_WIDTHS = (96, 96, 192)
_CHANNELS = 96
_RAW_CHANNELS = 10


@dataclasses.dataclass(frozen=True)
class RPMNetSettings:
    """The published ones; tested with five iterations, trained with two."""

    neighbors: int = 64
    radius: float = 0.3
    passes: int = 5
    iterations: int = 5
    optimized: bool = True


class Features(nn.Module):
    """MLP on every neighbor, maximum, MLP on every point; unit rows."""

    @nn.compact
    def __call__(
        self, raw: Float[Array, "n k 10"], mask: Bool[Array, " n"] | None = None
    ) -> Float[Array, "n 96"]:
        layers, width = [], raw.shape[-1]
        for i, wider in enumerate(_WIDTHS):
            layers.append(layer_of(self, f"neighbor_{i}", width, wider))
            width = wider
        x = pooled_features(tuple(layers), raw, groups=GROUPS, mask=mask)
        for i, wider in enumerate((192, _CHANNELS)):
            layer = layer_of(self, f"point_{i}", x.shape[-1], wider)
            x = nn.relu(apply_layer(layer, x, groups=GROUPS, mask=mask))
        return unit_rows(nn.Dense(_CHANNELS, kernel_init=kernel_init, name="out")(x))


class RPMNet(nn.Module):
    """The two learned parts, shared by all iterations."""

    def setup(self):
        self.features = Features()
        self.annealing = AnnealingNet(iterations=1)

    def __call__(self, raw, source, target):
        """Touches every part once, so that `init` makes all parameters."""
        return self.features(raw), self.annealing(source, target)


def init_params(key: jax.Array) -> dict:
    """Fresh parameters, a pytree of float32 arrays."""
    points, raw = jnp.zeros((2, 3)), jnp.zeros((2, 1, _RAW_CHANNELS))
    return RPMNet().init(key, raw, points, points)["params"]


def unroll(params: dict, source: Cloud, target: Cloud, settings: RPMNetSettings) -> Iterator[Step]:
    """The iterations, one by one; the clouds' `neighbors` are not used.

    As published, no gradient flows through the motion between two iterations.
    """
    network = bind(params)
    form = "auto" if settings.optimized else "log space"
    moved, balls = source, None
    for _ in range(settings.iterations):
        if balls is None or not settings.optimized:
            balls = [find_neighbors(cloud, settings) for cloud in (moved, target)]
        annealing = network.annealing(moved.points, target.points, source.mask, target.mask)
        features = [
            extract(network, cloud, ball)
            for cloud, ball in zip((moved, target), balls, strict=True)
        ]
        affinity = Affinity(*features, annealing.beta[0], annealing.alpha[0])
        found = match(
            affinity,
            target.points,
            passes=settings.passes,
            form=form,
            source_mask=source.mask,
            target_mask=target.mask,
        )
        transform = rigid.fit_rigid(source.points, found.targets, found.weights)
        yield Step(transform, found, affinity)
        moved = moved_by(lax.stop_gradient(transform), source)


def bind(params: dict) -> RPMNet:
    """The network with its parameters inside."""
    return RPMNet().bind({"params": params})


def find_neighbors(cloud: Cloud, settings: RPMNetSettings) -> Int32[Array, "n k"]:
    """The neighborhoods of a cloud where it is now."""
    return first_in_ball(
        lax.stop_gradient(cloud.points), settings.neighbors, settings.radius, cloud.mask
    )


def extract(network: RPMNet, cloud: Cloud, neighbors: Int32[Array, "n k"]) -> Float[Array, "n 96"]:
    """The features of a cloud where it is now; unit rows."""
    raw = raw_features(cloud.points, cloud.normals, neighbors, ppf="angle", position=True)
    return network.features(raw, cloud.mask)
