"""FMR (Feature-Metric Registration, Huang, Mei & Zhang, CVPR 2020): no correspondences at all.

One vector describes a cloud. The motion is what makes that of the moved source equal to that of the
target, found by inverse-compositional Gauss-Newton steps (Lucas & Kanade, 1981), whose Jacobian is
taken once, of the target. A decoder that makes points of a vector again serves in training alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from cfr_jax.geometry import rigid
from cfr_jax.geometry.closest import closest
from cfr_jax.networks.inputs import Cloud
from cfr_jax.networks.layers import kernel_init
from cfr_jax.networks.peers.batch_norm import NormedLinear, apply_in_training, places_of_layer
from cfr_jax.networks.peers.gauss_newton import jacobian, steps_of
from cfr_jax.networks.peers.maximum import highest
from cfr_jax.networks.record import Checkpoint, Goal, Motion, Network, Params, Part, Place
from cfr_jax.networks.timed_parts import FEATURES, MOTION

_ENCODER = (64, 64, 64, 128, 1024)
_DECODER = (1024, 512, 256)
_MADE = 2048  # points of the decoder
_STEP = 0.01  # of the finite differences, before it is trained


@dataclasses.dataclass(frozen=True)
class FMRSettings:
    """The published ones."""

    neighbors: int = 1
    """None is used."""
    radius: float = 0.3
    iterations: int = 10
    supervised: bool = False
    """Train the motion, too; as published, the autoencoder alone learns."""


class Encoder(nn.Module):
    """An MLP on every point, then the maximum."""

    training: bool = False

    @nn.compact
    def __call__(
        self, points: Float[Array, "n 3"], mask: Bool[Array, " n"] | None = None
    ) -> Float[Array, " c"]:
        x = points
        for i, width in enumerate(_ENCODER):
            x = NormedLinear(width, True, self.training, name=f"point_{i}")(x, mask)
        if mask is not None:
            x = jnp.where(mask[:, None], x, 0)  # as small as a ReLU leaves anything
        return highest(x)


class Decoder(nn.Module):
    """Points from a vector, within the cube from -1 to 1."""

    training: bool = False

    @nn.compact
    def __call__(self, vector: Float[Array, " c"]) -> Float[Array, "p 3"]:
        x = vector
        for i, width in enumerate(_DECODER):
            x = NormedLinear(width, True, self.training, name=f"cloud_{i}")(x)
        x = nn.Dense(3 * _MADE, kernel_init=kernel_init, name="out")(x)
        return jnp.tanh(x).reshape(3, _MADE).T


class FMR(nn.Module):
    """The learned parts: encoder, decoder, and the steps of the finite differences."""

    decoded: bool = True
    training: bool = False

    def setup(self) -> None:
        self.encoder: Encoder = Encoder(self.training)
        if self.decoded:
            self.decoder: Decoder = Decoder(self.training)
        self.step: Array = self.param("step", nn.initializers.constant(_STEP), (6, 1))

    def encode(
        self, points: Float[Array, "n 3"], mask: Bool[Array, " n"] | None = None
    ) -> Float[Array, " c"]:
        """The vector of a centered cloud."""
        return self.encoder(points, mask)

    def __call__(
        self, points: Float[Array, "n 3"], mask: Bool[Array, " n"] | None = None
    ) -> Float[Array, "p 3"]:
        """A centered cloud, made again from its vector; the vector without decoder."""
        vector = self.encoder(points, mask)
        return self.decoder(vector) if self.decoded else vector


def init_params(key: jax.Array, iterations: int | None = None, decoded: bool = True) -> Params:
    """Fresh parameters, a pytree of float32 arrays; any number of `iterations` shares them.
    Without `decoded` they lack the decoder, which a registration does not need."""
    return FMR(decoded).init(key, jnp.zeros((2, 3), jnp.float32))["params"]


def unroll(params: Params, source: Cloud, target: Cloud, settings: FMRSettings) -> Iterator[Motion]:
    """The iterations, one by one; neither normals nor neighbors are used.

    Gradients flow through all of them. Once a step is below 1e-7, none follows.
    """
    network = FMR("decoder" in params).bind({"params": params})
    (q, to_source), (p, to_target) = _centered(source), _centered(target)

    def encode(points: Array, mask: Array | None) -> Array:
        return network.encode(points, mask)

    vector, slope = jacobian(lambda points: encode(points, target.mask), p, params["step"][:, 0])
    found = steps_of(
        lambda points: encode(points, source.mask), q, vector, slope, settings.iterations
    )
    for motion in found:
        yield Motion(rigid.compose(rigid.inverse(to_target), rigid.compose(motion, to_source)))


def objective(
    params: Params, source: Cloud, target: Cloud, truth: Float[Array, "4 4"], settings: FMRSettings
) -> Goal:
    """The published losses: the Chamfer distances of both clouds to what the decoder makes of them;
    with `supervised` also the squared entries of T T_truth^-1 - I, summed."""
    module = FMR(training=True)
    remade = total = jnp.zeros((), source.points.dtype)
    for cloud in (target, source):
        points, _ = _centered(cloud)
        made, pull = apply_in_training(module, params, points, cloud.mask)
        remade += _chamfer(points, made) + pull
    total += remade
    transforms = jnp.stack([each.transform for each in unroll(params, source, target, settings)])
    if not settings.supervised:
        return Goal(total, lax.stop_gradient(transforms))
    left = rigid.compose(transforms[-1], rigid.inverse(truth)) - jnp.eye(4, dtype=truth.dtype)
    return Goal(total + jnp.sum(left * left), transforms)


def _chamfer(points: Float[Array, "n 3"], made: Float[Array, "p 3"]) -> Float[Array, ""]:
    """Mean squared distance to the nearest point, there and back."""
    return jnp.mean(closest(points, made).square) + jnp.mean(closest(made, points).square)


def _centered(cloud: Cloud) -> tuple[Float[Array, "n 3"], Float[Array, "4 4"]]:
    """The points about their centroid, and the motion there."""
    points, mask = cloud.points, cloud.mask
    valid = jnp.ones(len(points), points.dtype) if mask is None else mask.astype(points.dtype)
    middle = jnp.sum(points * valid[:, None], axis=0) / jnp.maximum(jnp.sum(valid), 1)
    return points - middle, rigid.from_parts(jnp.eye(3, dtype=points.dtype), -middle)


def parts(params: Params, settings: FMRSettings) -> Callable[[Cloud, Cloud], Iterator[Part]]:
    """All parts of the registration of two clouds, for timing: the vectors, and all else."""
    network = FMR("decoder" in params).bind({"params": params})
    encode = jax.jit(lambda points: network.encode(points))
    point = jnp.ones((1, 3))
    step = jax.jit(lambda wanted, slope: steps_of(lambda _: 0 * wanted, point, wanted, slope, 1))

    def of(source: Cloud, target: Cloud) -> Iterator[Part]:
        # once and six times of the target, of the source in every iteration
        yield Part(FEATURES, encode, (target.points,), 7)
        yield Part(FEATURES, encode, (source.points,), settings.iterations)
        vector = encode(source.points)
        slope = jnp.tile(jnp.eye(6), (len(vector) // 6 + 1, 1))[: len(vector)]
        yield Part(MOTION, step, (vector, slope), settings.iterations)

    return of


def _trained(neighbors: int, iterations: int) -> FMRSettings:
    return FMRSettings(neighbors=neighbors, iterations=iterations)


def _recognizes(tensors: Collection[str]) -> bool:
    return any(name.startswith("encoder/point_") for name in tensors)


def _arguments(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Any]:
    return {"decoded": any(name.startswith("decoder/") for name in shapes)}


def _theirs(tensors: Collection[str]) -> bool:
    return any(name.startswith("encoder.h1.") for name in tensors)


def _arguments_of_theirs(tensors: Mapping[str, Any]) -> dict[str, Any]:
    return {}


def _places(tensors: Mapping[str, Any]) -> dict[str, Place]:
    places = {"dt": "step"}
    numbers = ("h1.0", "h1.1"), ("h1.3", "h1.4"), ("h2.0", "h2.1"), ("h2.3", "h2.4")
    for i, (linear, norm) in enumerate((*numbers, ("h2.6", "h2.7"))):
        theirs = f"encoder.{linear}", f"encoder.{norm}"
        places |= places_of_layer(theirs, f"encoder/point_{i}", bias=True)
    for i in range(len(_DECODER)):
        theirs = f"decoder.fc{i + 1}", f"decoder.bn{i + 1}"
        places |= places_of_layer(theirs, f"decoder/cloud_{i}", bias=True)
    places |= {"decoder.fc4.weight": "decoder/out/kernel", "decoder.fc4.bias": "decoder/out/bias"}
    return {theirs: Place(ours) for theirs, ours in places.items()}


NETWORK = Network(
    name="fmr",
    title="FMR",
    settings=FMRSettings,
    fresh=init_params,
    unroll=unroll,
    recognizes=_recognizes,
    arguments=_arguments,
    trained=_trained,
    validated=FMRSettings(),
    changeable=("supervised",),
    own_neighbors=True,
    parts=parts,
    objective=objective,
    checkpoint=Checkpoint(
        _theirs, _arguments_of_theirs, _places, passed_over=("num_batches_tracked",)
    ),
)
