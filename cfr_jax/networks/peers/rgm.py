"""RGM (Robust Graph Matching, Fu, Liu, Luo & Wang, CVPR 2021): two graphs, matched twice.

A transformer draws the edges of each cloud's graph; a graph convolution mixes the features along
them; an affinity of the mixed features, brought to a common scale, goes through twenty Sinkhorn
passes. A second layer does that again, with features that have seen their partners. The motion
comes from a one-to-one assignment made of the soft one, which no gradient passes: training sees the
soft assignment alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfr_jax.networks.inputs import Cloud
from cfr_jax.networks.peers import assignment
from cfr_jax.networks.peers.batch_norm import apply_in_training
from cfr_jax.networks.peers.dcp import check_width
from cfr_jax.networks.peers.edges import EdgeFeatures, places_of_edges
from cfr_jax.networks.peers.graphs import GraphLayer, places_of_graphs
from cfr_jax.networks.peers.transformer import check_sizes
from cfr_jax.networks.record import Checkpoint, Goal, Motion, Network, Params, Part, Place
from cfr_jax.networks.timed_parts import FEATURES, MATCHING, NEIGHBORS, on_host

WIDTH = 512
_INLIER = 0.5  # least sum of a row or a column that is assigned
_LEAST_LOG = -100.0  # of a probability in the loss, as published


@dataclasses.dataclass(frozen=True)
class RGMSettings:
    """The published ones for partial, noisy clouds."""

    neighbors: int = 19
    """Of each point beside itself; the published 20 count it."""
    radius: float = np.inf
    passes: int = 20
    slack: bool = True
    """Whether points may stay without partner; for clean pairs they may not."""
    rounds: int = 2
    """How often the clouds are matched, each time from where the last one left them."""
    training: bool = False
    """Batch norm by the statistics of the batch, for which see `peers.batch_norm`."""


class RGM(nn.Module):
    """The learned parts: features, and two layers of matching with an exchange between them."""

    width: int = WIDTH
    passes: int = RGMSettings.passes
    slack: bool = RGMSettings.slack
    training: bool = False

    @nn.compact
    def __call__(self, source: Cloud, target: Cloud) -> Float[Array, "n m"]:
        """The logarithm of the soft assignment; minus infinity where masked."""
        features = EdgeFeatures(self.width, self.training, name="edges")
        x, y = (
            jnp.concatenate(features(cloud.points, cloud.neighbors, cloud.mask), axis=-1)
            for cloud in (source, target)
        )
        exchange = nn.Dense(self.width, name="exchange")
        for i in range(2):
            layer = GraphLayer(self.width, self.passes, self.slack, name=f"graph_{i}")
            log_plan, x, y = layer(x, y, source.mask, target.mask)
            if i == 0:
                plan = jnp.exp(log_plan)
                x, y = (
                    exchange(jnp.concatenate(pair, axis=-1))
                    for pair in ((x, plan @ y), (y, plan.T @ x))
                )
        return log_plan


def init_params(key: jax.Array, iterations: int | None = None, width: int = 0) -> Params:
    """Fresh parameters, a pytree of float32 arrays, with features so wide (0: 512). There is one
    iteration, whatever `iterations` says."""
    check_width(width)
    points = jnp.zeros((2, 3), jnp.float32)
    cloud = Cloud(points, points, jnp.zeros((2, 1), jnp.int32))
    return RGM(width or WIDTH, passes=1).init(key, cloud, cloud)["params"]


def unroll(params: Params, source: Cloud, target: Cloud, settings: RGMSettings) -> Iterator[Motion]:
    """The one answer: clouds are matched both ways, and pairs kept that both found.

    The host assigns (`assignment.assign`), so no gradient passes. Normals are not used. Unlike in
    the published program, clouds may have different numbers of points.
    """
    check_sizes("RGM", len(source.points), len(target.points))

    def match(x: Cloud, y: Cloud) -> Float[Array, "n m"]:
        return assignment.assign(
            _log_plan(params, x, y, settings), _INLIER if settings.slack else 0
        )

    there = assignment.in_rounds(match, source, target, settings.rounds)
    back = assignment.in_rounds(match, target, source, settings.rounds)
    yield Motion(assignment.motion_of(there * back.T, source, target))


def objective(
    params: Params,
    source: Cloud,
    target: Cloud,
    truth: Float[Array, "4 4"],
    settings: RGMSettings,
) -> Goal:
    """The published loss: cross-entropy of the entries of the soft assignment to the true one,
    summed over them and divided by the number of source points. What is reported is the motion of
    the soft assignment."""
    module = module_of(params, settings)
    log_plan, pull = apply_in_training(module, params, source, target)
    wanted = assignment.true_assignment(source, target, truth)
    matched = jnp.maximum(log_plan, _LEAST_LOG)
    plan = jnp.exp(log_plan)
    apart = plan < 1
    unmatched = jnp.where(apart, jnp.log1p(-jnp.where(apart, plan, 0)), _LEAST_LOG)
    entropy = -jnp.sum(wanted * matched + (1 - wanted) * jnp.maximum(unmatched, _LEAST_LOG))
    count = len(source.points) if source.mask is None else jnp.maximum(jnp.sum(source.mask), 1)
    soft = assignment.motion_of(jax.lax.stop_gradient(plan), source, target)
    return Goal(entropy / count + pull, soft[None])


def _log_plan(
    params: Params, source: Cloud, target: Cloud, settings: RGMSettings
) -> Float[Array, "n m"]:
    found: Array = module_of(params, settings).bind({"params": params})(source, target)
    return found


def module_of(params: Mapping[str, Any], settings: RGMSettings) -> RGM:
    """The module that parameters are made for."""
    width = params["edges"]["point"]["norm"]["scale"].shape[0]
    return RGM(width, settings.passes, settings.slack, settings.training)


def parts(params: Params, settings: RGMSettings) -> Callable[[Cloud, Cloud], Iterator[Part]]:
    """All parts of the registration of two clouds, for timing; here features are all of the
    network."""
    soft = jax.jit(lambda source, target: _log_plan(params, source, target, settings))
    assigned = jax.jit(lambda log_plan: assignment.assign(log_plan, _INLIER))

    def of(source: Cloud, target: Cloud) -> Iterator[Part]:
        clouds = []
        for cloud in (source, target):
            points = np.asarray(cloud.points)
            k = min(settings.neighbors, len(points) - 1)
            yield Part(NEIGHBORS, on_host, (points, k, settings.radius))
            found = jnp.asarray(on_host(points, k, settings.radius))
            clouds.append(Cloud(cloud.points, cloud.normals, found))
        yield Part(FEATURES, soft, tuple(clouds), 2 * settings.rounds)
        yield Part(MATCHING, assigned, (soft(*clouds),), 2 * settings.rounds)

    return of


def _trained(neighbors: int, iterations: int) -> RGMSettings:
    return RGMSettings(neighbors=neighbors, training=True)


def _recognizes(tensors: Collection[str]) -> bool:
    return any(name.startswith("graph_0/") for name in tensors)


def _arguments(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Any]:
    return {"width": shapes.get("edges/point/norm/scale", (WIDTH,))[0]}


def _theirs(tensors: Collection[str]) -> bool:
    return any(name.startswith("pointfeaturer.") for name in tensors)


def _arguments_of_theirs(tensors: Mapping[str, Any]) -> dict[str, Any]:
    return {"width": np.shape(tensors.get("pointfeaturer.bn5.bias", np.zeros(WIDTH)))[0]}


def _places(tensors: Mapping[str, Any]) -> dict[str, Place]:
    places = places_of_edges("pointfeaturer", "edges") | places_of_graphs()
    places |= {"cross_graph_0.weight": "exchange/kernel", "cross_graph_0.bias": "exchange/bias"}
    return {theirs: Place(ours) for theirs, ours in places.items()}


NETWORK = Network(
    name="rgm",
    title="RGM",
    settings=RGMSettings,
    fresh=init_params,
    unroll=unroll,
    recognizes=_recognizes,
    arguments=_arguments,
    trained=_trained,
    validated=RGMSettings(),
    variants=("width",),
    changeable=("slack", "passes"),
    parts=parts,
    objective=objective,
    checkpoint=Checkpoint(
        _theirs, _arguments_of_theirs, _places, passed_over=("num_batches_tracked",)
    ),
)
