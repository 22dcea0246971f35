"""The iterations of a registration, step by step.

`registration.register` runs them and returns the answer; the loss and the measurements look at the
steps in between.
"""

from __future__ import annotations

from collections.abc import Iterator

import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Float

from cfr_jax.geometry import rigid
from cfr_jax.geometry.neighbors import others
from cfr_jax.networks.cfr.modules import CFR
from cfr_jax.networks.features import raw_features
from cfr_jax.networks.inputs import Cloud, Settings, moved_by
from cfr_jax.networks.record import Params, Step
from cfr_jax.networks.sinkhorn import Affinity, match
from cfr_jax.runtime.values import ByValue


@struct.dataclass(eq=False)
class Encoded(ByValue):
    """The target's side of a registration, computed once for any number of sources."""

    cloud: Cloud
    features: Float[Array, "L m d"]


def iterate(
    params: Params, source: Cloud, target: Encoded, iterations: int, settings: Settings
) -> Iterator[Step]:
    """Yields the iterations of `register` one by one, for callers that need the steps in between.

    This is a scan over the parameters stacked along L, unrolled: iteration i runs i Sinkhorn
    passes, and that number could not be static inside a compiled loop.
    """
    network, count = bind(params), iterations_of(params)
    reference = target.cloud
    annealing = network.annealing(source.points, reference.points, source.mask, reference.mask)
    received = features = heavy_features(network, source, settings)
    moved = source
    for i in range(iterations):
        layer = min(i, count - 1)
        if i and settings.repeat_annealing:
            annealing = network.annealing(
                moved.points, reference.points, source.mask, reference.mask
            )
        if i and settings.repeat_extraction:
            received = heavy_features(network, moved, settings)
        elif i == layer:
            received = features
        features = network.cascade.layer(layer, received, moved.points, source.mask)
        affinity = Affinity(
            features, target.features[layer], annealing.beta[layer], annealing.alpha[layer]
        )
        found = match(
            affinity,
            reference.points,
            passes=layer + 1 if settings.passes is None else settings.passes,
            form=settings.match,
            source_mask=source.mask,
            target_mask=reference.mask,
        )
        transform = rigid.fit_rigid(source.points, found.targets, found.weights)
        yield Step(transform, found, affinity)
        moved = moved_on(transform, source, settings)


def moved_on(transform: Float[Array, "4 4"], source: Cloud, settings: Settings) -> Cloud:
    """The source moved by the `transform` that an iteration found, for the next iteration."""
    return moved_by(lax.stop_gradient(transform) if settings.detach_motion else transform, source)


def encoded(params: Params, cloud: Cloud, settings: Settings) -> Encoded:
    """The features of a target in every iteration."""
    network = bind(params)
    heavy = heavy_features(network, cloud, settings)
    if settings.repeat_extraction:
        layers = range(iterations_of(params))
        every = [network.cascade.layer(i, heavy, cloud.points, cloud.mask) for i in layers]
        return Encoded(cloud, jnp.stack(every))
    return Encoded(cloud, network.cascade.at_rest(heavy, cloud.points, cloud.mask))


def unroll(params: Params, source: Cloud, target: Cloud, settings: Settings) -> Iterator[Step]:
    """Yields as many iterations as the parameters were made for; neither cloud is encoded yet."""
    reference = encoded(params, target, settings)
    return iterate(params, source, reference, iterations_of(params), settings)


def iterations_of(params: Params) -> int:
    """L: the number of iterations that the parameters were made for."""
    return params["annealing"]["out"]["bias"].shape[0] // 2


def bind(params: Params) -> CFR:
    """The network with these parameters bound to it."""
    shared = params["cascade"]["kernel"].shape[0] == 1
    return CFR(iterations_of(params), shared).bind({"params": params})


def heavy_features(network: CFR, cloud: Cloud, settings: Settings) -> Float[Array, "n d"]:
    """The heavy features that all iterations start from, before any light layer."""
    raw = raw_features(cloud.points, cloud.normals, cloud.neighbors, ppf=settings.ppf)
    columns = others(cloud.mask, cloud.neighbors.shape[1])
    return network.features(raw, cloud.mask, settings.activations, columns)
