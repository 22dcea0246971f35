"""DCP (Deep Closest Point, Wang & Solomon, ICCV 2019): one soft match of learned features.

Version v2 lets each cloud's features look at the other cloud through a transformer; v1 does not.
The network takes the clouds where they are, without normals, and answers once.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from cfr_jax.geometry import rigid
from cfr_jax.networks.inputs import Cloud
from cfr_jax.networks.peers.batch_norm import apply_in_training
from cfr_jax.networks.peers.edges import EdgeFeatures, places_of_edges
from cfr_jax.networks.peers.transformer import (
    Transformer,
    check_sizes,
    places_of_transformer,
)
from cfr_jax.networks.record import Checkpoint, Goal, Network, Params, Part, Place, Step
from cfr_jax.networks.sinkhorn import Affinity, Match
from cfr_jax.networks.timed_parts import FEATURES, MATCHING, MOTION, NEIGHBORS, move, on_host

WIDTH = 512
ATTENTION = "attention"  # as figures call this part


@dataclasses.dataclass(frozen=True)
class DCPSettings:
    """The published ones."""

    neighbors: int = 19
    """Of each point beside itself; the published 20 count it."""
    radius: float = np.inf
    training: bool = False
    """Batch norm by the statistics of the batch, for which see `peers.batch_norm`."""


class DCP(nn.Module):
    """The learned parts: features of a cloud, and what the transformer makes of two."""

    width: int = WIDTH
    transformed: bool = True
    training: bool = False

    def setup(self) -> None:
        self.embedding: EdgeFeatures = EdgeFeatures(self.width, self.training)
        if self.transformed:
            self.pointer: Transformer = Transformer(2 * self.width)

    def embed(self, cloud: Cloud) -> Float[Array, "n w"]:
        """The features of a cloud by itself."""
        return self.embedding(cloud.points, cloud.neighbors, cloud.mask)[1]

    def point(
        self, f: Float[Array, "n w"], g: Float[Array, "m w"], source: Cloud, target: Cloud
    ) -> tuple[Float[Array, "n w"], Float[Array, "m w"]]:
        """The features that are matched, from those of each cloud by itself."""
        if not self.transformed:
            return 2 * f, 2 * g  # as published: the pointer of v1 is the identity, and it is added
        masks = source.mask, target.mask
        return f + self.pointer(f, g, *masks), g + self.pointer(g, f, *masks[::-1])

    def __call__(
        self, source: Cloud, target: Cloud
    ) -> tuple[Float[Array, "n w"], Float[Array, "m w"]]:
        """The features of both clouds as they are matched."""
        return self.point(self.embed(source), self.embed(target), source, target)


def init_params(
    key: jax.Array, iterations: int | None = None, width: int = 0, version: str = ""
) -> Params:
    """Fresh parameters, a pytree of float32 arrays: of "v2" or "v1", with features so wide ("" and
    0: v2, 512). There is one iteration, whatever `iterations` says."""
    if version not in ("", "v1", "v2"):
        raise ValueError(f"version: got {version!r}, wanted 'v1' or 'v2' of DCP")
    check_width(width)
    points = jnp.zeros((2, 3), jnp.float32)
    cloud = Cloud(points, points, jnp.zeros((2, 1), jnp.int32))
    return DCP(width or WIDTH, version != "v1").init(key, cloud, cloud)["params"]


def check_width(width: int) -> None:
    """Raises ValueError where features cannot be so wide; 0 stands for as published."""
    if width < 0 or width % 8:
        raise ValueError(f"width: got {width}, wanted a multiple of 8")


def unroll(params: Params, source: Cloud, target: Cloud, settings: DCPSettings) -> Iterator[Step]:
    """The one answer; normals are not used, and neither are gradients stopped."""
    check_sizes("DCP", len(source.points), len(target.points))
    f, g = module_of(params).bind({"params": params})(source, target)
    yield step_of(f, g, source, target)


def objective(
    params: Params,
    source: Cloud,
    target: Cloud,
    truth: Float[Array, "4 4"],
    settings: DCPSettings,
) -> Goal:
    """The published loss: mean squared entries of R^T R_truth - I and of t - t_truth."""
    module = module_of(params, training=settings.training)
    (f, g), pull = apply_in_training(module, params, source, target)
    found = step_of(f, g, source, target).transform
    turned = jnp.matmul(found[:3, :3].T, truth[:3, :3], precision=lax.Precision.HIGHEST)
    of_rotation = jnp.mean((turned - jnp.eye(3, dtype=turned.dtype)) ** 2)
    of_translation = jnp.mean((found[:3, 3] - truth[:3, 3]) ** 2)
    return Goal(of_rotation + of_translation + pull, found[None])


def step_of(f: Float[Array, "n w"], g: Float[Array, "m w"], source: Cloud, target: Cloud) -> Step:
    """The match of two sets of features and the motion that it asks for.

    A score is f . g / sqrt(w), and a row of the match the softmax of its scores: every source point
    finds its partner, no target point needs one.
    """
    width = f.shape[-1]
    # log m = f . g / sqrt(w), written as the other networks have it
    sharpness = jnp.asarray(1 / (2 * np.sqrt(width)), f.dtype)
    affinity = Affinity(f, g, sharpness, jnp.asarray(2, f.dtype))
    scores = affinity.log()
    if target.mask is not None:
        scores = jnp.where(target.mask, scores, -jnp.inf)
    rows = nn.softmax(scores, axis=1)
    targets = jnp.matmul(rows, target.points, precision=lax.Precision.HIGHEST)
    weights = jnp.ones(len(f), f.dtype) if source.mask is None else source.mask.astype(f.dtype)
    covered = jnp.minimum(jnp.sum(rows * weights[:, None], axis=0), 1)
    transform = rigid.fit_rigid(source.points, targets, weights)
    return Step(transform, Match(weights, targets, covered), affinity)


def module_of(params: Mapping[str, Any], training: bool = False) -> DCP:
    """The module that parameters are made for."""
    width = params["embedding"]["point"]["norm"]["scale"].shape[0]
    return DCP(width, "pointer" in params, training)


def parts(params: Params, settings: DCPSettings) -> Callable[[Cloud, Cloud], Iterator[Part]]:
    """All parts of the registration of two clouds, for timing."""
    network = module_of(params).bind({"params": params})
    embed = jax.jit(lambda cloud: network.embed(cloud))
    point = jax.jit(lambda *given: network.point(*given))
    matched = jax.jit(lambda *given: step_of(*given).match)

    def of(source: Cloud, target: Cloud) -> Iterator[Part]:
        clouds, features = [], []
        for cloud in (source, target):
            points = np.asarray(cloud.points)
            k = min(settings.neighbors, len(points) - 1)
            yield Part(NEIGHBORS, on_host, (points, k, settings.radius))
            found = jnp.asarray(on_host(points, k, settings.radius))
            clouds.append(Cloud(cloud.points, cloud.normals, found))
            yield Part(FEATURES, embed, (clouds[-1],))
            features.append(embed(clouds[-1]))
        yield Part(ATTENTION, point, (*features, *clouds))
        given = (*point(*features, *clouds), *clouds)
        yield Part(MATCHING, matched, given)
        yield Part(MOTION, move, (source.points, matched(*given)))

    return of


def _trained(neighbors: int, iterations: int) -> DCPSettings:
    return DCPSettings(neighbors=neighbors, training=True)


def _recognizes(tensors: Collection[str]) -> bool:
    return any(name.startswith("embedding/") for name in tensors)


def _arguments(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Any]:
    (width,) = shapes.get("embedding/point/norm/scale", (WIDTH,))
    transformed = any(name.startswith("pointer/") for name in shapes)
    return {"width": width, "version": "v2" if transformed else "v1"}


def _theirs(tensors: Collection[str]) -> bool:
    return any(name.startswith("emb_nn.") for name in tensors)


def _arguments_of_theirs(tensors: Mapping[str, Any]) -> dict[str, Any]:
    transformed = any(name.startswith("pointer.") for name in tensors)
    width = np.shape(tensors.get("emb_nn.bn5.bias", np.zeros(WIDTH)))[0]
    return {"width": width, "version": "v2" if transformed else "v1"}


def _places(tensors: Mapping[str, Any]) -> dict[str, Place]:
    places = places_of_edges("emb_nn", "embedding")
    if _arguments_of_theirs(tensors)["version"] == "v2":
        places |= places_of_transformer("pointer.model", "pointer")
    return {theirs: Place(ours) for theirs, ours in places.items()}


NETWORK = Network(
    name="dcp",
    title="DCP",
    settings=DCPSettings,
    fresh=init_params,
    unroll=unroll,
    recognizes=_recognizes,
    arguments=_arguments,
    trained=_trained,
    validated=DCPSettings(),
    variants=("width", "version"),
    parts=parts,
    objective=objective,
    checkpoint=Checkpoint(
        _theirs,
        _arguments_of_theirs,
        _places,
        # how many batches there were, and diag(1, 1, -1)
        passed_over=("num_batches_tracked", "head.reflect"),
    ),
)
