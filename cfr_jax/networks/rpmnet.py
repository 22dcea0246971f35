"""RPM-Net (Yew & Lee, CVPR 2020), the method that CFR builds on and is compared with.

Every iteration extracts the features of both clouds again, predicts its own annealing parameters,
and normalizes in log space with five passes. `optimized` is RPMNet (Optim) of the CFR paper: it
uses log-free Sinkhorn and searches neighborhoods only once, as a rigid motion does not change them.
The answers are the same.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int32

from cfr_jax.geometry import rigid
from cfr_jax.geometry.neighbors import first_in_ball
from cfr_jax.networks.annealing import AUTHORS_LAYERS, AnnealingNet
from cfr_jax.networks.extraction import pooled_features
from cfr_jax.networks.features import raw_features
from cfr_jax.networks.inputs import Cloud, moved_by
from cfr_jax.networks.layers import GROUPS, apply_layer, kernel_init, layer_of, unit_rows
from cfr_jax.networks.record import Checkpoint, Network, Params, Part, Place, Step, places_of
from cfr_jax.networks.sinkhorn import Affinity, Form, match
from cfr_jax.networks.timed_parts import (
    ANNEALING,
    FEATURES,
    MATCHING,
    MOTION,
    NEIGHBORS,
    matching,
    move,
)

_WIDTHS = (96, 96, 192)
_CHANNELS = 96
_RAW_CHANNELS = 10
_LAYERS = (
    *AUTHORS_LAYERS,
    (
        "feat_extractor.prepool.0",
        "features/neighbor_0_dense/kernel",
        "features/neighbor_0_dense/bias",
    ),
    ("feat_extractor.prepool.1", "features/neighbor_0_scale", "features/neighbor_0_shift"),
    (
        "feat_extractor.prepool.3",
        "features/neighbor_1_dense/kernel",
        "features/neighbor_1_dense/bias",
    ),
    ("feat_extractor.prepool.4", "features/neighbor_1_scale", "features/neighbor_1_shift"),
    (
        "feat_extractor.prepool.6",
        "features/neighbor_2_dense/kernel",
        "features/neighbor_2_dense/bias",
    ),
    ("feat_extractor.prepool.7", "features/neighbor_2_scale", "features/neighbor_2_shift"),
    ("feat_extractor.postpool.0", "features/point_0_dense/kernel", "features/point_0_dense/bias"),
    ("feat_extractor.postpool.1", "features/point_0_scale", "features/point_0_shift"),
    ("feat_extractor.postpool.3", "features/point_1_dense/kernel", "features/point_1_dense/bias"),
    ("feat_extractor.postpool.4", "features/point_1_scale", "features/point_1_shift"),
    ("feat_extractor.postpool.6", "features/out/kernel", "features/out/bias"),
)


@dataclasses.dataclass(frozen=True)
class RPMNetSettings:
    """The published settings, for testing with five iterations; it was trained with two."""

    neighbors: int = 64
    radius: float = 0.3
    passes: int = 5
    iterations: int = 5
    optimized: bool = True


class Features(nn.Module):
    """An MLP on every neighbor, the maximum, and an MLP on every point; rows have length one."""

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

    def setup(self) -> None:
        self.features: Features = Features()
        self.annealing: AnnealingNet = AnnealingNet(iterations=1)

    def __call__(self, raw: Array, source: Array, target: Array) -> object:
        """Runs every part once, so that `init` makes all parameters."""
        return self.features(raw), self.annealing(source, target)


def init_params(key: jax.Array, iterations: int | None = None) -> Params:
    """Fresh parameters, a pytree of float32 arrays; they do not depend on `iterations`."""
    points, raw = jnp.zeros((2, 3)), jnp.zeros((2, 1, _RAW_CHANNELS))
    return RPMNet().init(key, raw, points, points)["params"]


def unroll(
    params: Params, source: Cloud, target: Cloud, settings: RPMNetSettings
) -> Iterator[Step]:
    """Yields the iterations one by one; does not use the `neighbors` of the clouds.

    As published, no gradient flows through the motion between two iterations.
    """
    network = bind(params)
    form: Form = "auto" if settings.optimized else "log space"
    moved, balls = source, None
    for _ in range(settings.iterations):
        if balls is None or not settings.optimized:
            balls = [find_neighbors(cloud, settings) for cloud in (moved, target)]
        annealing = network.annealing(moved.points, target.points, source.mask, target.mask)
        of_source, of_target = (
            extract(network, cloud, ball)
            for cloud, ball in zip((moved, target), balls, strict=True)
        )
        affinity = Affinity(of_source, of_target, annealing.beta[0], annealing.alpha[0])
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


def bind(params: Params) -> RPMNet:
    """The network with these parameters bound to it."""
    return RPMNet().bind({"params": params})


def find_neighbors(cloud: Cloud, settings: RPMNetSettings) -> Int32[Array, "n k"]:
    """The neighborhoods of a cloud at its current position."""
    return first_in_ball(
        lax.stop_gradient(cloud.points), settings.neighbors, settings.radius, cloud.mask
    )


def extract(network: RPMNet, cloud: Cloud, neighbors: Int32[Array, "n k"]) -> Float[Array, "n 96"]:
    """The features of a cloud at its current position; rows have length one."""
    raw = raw_features(cloud.points, cloud.normals, neighbors, ppf="angle", position=True)
    return network.features(raw, cloud.mask)


def parts(params: Params, settings: RPMNetSettings) -> Callable[[Cloud, Cloud], Iterator[Part]]:
    """A function that yields all parts of the registration of two clouds, for timing."""
    network, count = bind(params), settings.iterations
    search = jax.jit(lambda cloud: find_neighbors(cloud, settings))
    extracted = jax.jit(lambda cloud, ball: extract(network, cloud, ball))
    anneal = jax.jit(lambda *clouds: network.annealing(*clouds))
    matched = matching("auto" if settings.optimized else "log space")

    def of(source: Cloud, target: Cloud) -> Iterator[Part]:
        features = []
        for cloud in (source, target):
            yield Part(NEIGHBORS, search, (cloud,), 1 if settings.optimized else count)
            ball = search(cloud)
            yield Part(FEATURES, extracted, (cloud, ball), count)
            features.append(extracted(cloud, ball))
        pair = source.points, target.points
        yield Part(ANNEALING, anneal, pair, count)
        beta, alpha = anneal(*pair)
        given = (*features, beta[0], alpha[0], target.points, settings.passes)
        yield Part(MATCHING, matched, given, count)
        yield Part(MOTION, move, (source.points, matched(*given)), count)

    return of


def _trained(neighbors: int, iterations: int) -> RPMNetSettings:
    return RPMNetSettings(neighbors=neighbors, iterations=iterations)


def _recognizes(tensors: Collection[str]) -> bool:
    return any(name.startswith("features/neighbor_") for name in tensors)


def _arguments(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Any]:
    return {}


def _theirs(tensors: Collection[str]) -> bool:
    return any(name.startswith("feat_extractor.") for name in tensors)


def _arguments_of_theirs(tensors: Collection[str]) -> dict[str, Any]:
    return {}


def _places(tensors: Collection[str]) -> dict[str, Place]:
    return places_of(_LAYERS)


NETWORK = Network(
    name="rpmnet",
    title="RPM-Net",
    settings=RPMNetSettings,
    fresh=init_params,
    unroll=unroll,
    recognizes=_recognizes,
    arguments=_arguments,
    trained=_trained,
    validated=RPMNetSettings(),
    own_neighbors=True,
    parts=parts,
    checkpoint=Checkpoint(_theirs, _arguments_of_theirs, _places),
)
