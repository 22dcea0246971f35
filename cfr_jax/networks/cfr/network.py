"""The record of CFR for the table of networks."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any

import jax
import numpy as np
from flax.traverse_util import flatten_dict

from cfr_jax.networks.annealing import AUTHORS_LAYERS
from cfr_jax.networks.cfr.iterations import bind, heavy_features, iterations_of, unroll
from cfr_jax.networks.cfr.modules import init_params
from cfr_jax.networks.inputs import Cloud, Settings
from cfr_jax.networks.probability import uncalibrated
from cfr_jax.networks.record import Checkpoint, Network, Params, Part, Place, places_of
from cfr_jax.networks.timed_parts import (
    ANNEALING,
    FEATURES,
    MATCHING,
    MOTION,
    NEIGHBORS,
    matching,
    move,
    on_host,
)

# Tracing takes a time that grows with them, and files may claim any number.
MOST_ITERATIONS = 100
_LAYERS = (
    *AUTHORS_LAYERS,
    ("feat_extractor_ball.prepool.0", "features/kernel_0", "features/bias_0"),
    ("feat_extractor_ball.prepool.1", "features/scale_0", "features/shift_0"),
    ("feat_extractor_ball.prepool.3", "features/kernel_1", "features/bias_1"),
    ("feat_extractor_ball.prepool.4", "features/scale_1", "features/shift_1"),
    ("feat_extractor_ball.prepool.6", "features/kernel_2", "features/bias_2"),
    ("feat_extractor_ball.prepool.7", "features/scale_2", "features/shift_2"),
)
_LAYERS_PER_ITERATION = (
    # one of each per iteration {}; here they are stacked along a leading axis
    ("feat_extractor_xyz.nets_a.{}.0", "cascade/scale", "cascade/shift"),
    ("feat_extractor_xyz.nets_a.{}.2", "cascade/kernel", "cascade/bias"),
    ("feat_extractor_xyz.nets_b.{}.0", "cascade/position", None),
)
_ITERATION = re.compile(r"feat_extractor_xyz\.nets_a\.(\d+)\.")
_PREFIXES = ("feat_extractor_ball.", "feat_extractor_xyz.")


def _trained(neighbors: int, iterations: int) -> Settings:
    # the number of iterations follows from the parameters
    return Settings(neighbors=neighbors, detach_motion=True)


def _recognizes(tensors: Collection[str]) -> bool:
    return any(name.startswith("cascade/") for name in tensors)


def _arguments(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Any]:
    annealing = math.prod(shapes.get("annealing/out/bias", (10,)))
    shared = shapes.get("cascade/kernel", ())[:1] == (1,)
    if annealing > 2 * MOST_ITERATIONS:
        raise ValueError(
            f"annealing/out/bias is for {annealing // 2:,} iterations, wanted at most "
            f"{MOST_ITERATIONS}"
        )
    return {"iterations": max(1, annealing // 2), "shared": shared}


def _theirs(tensors: Collection[str]) -> bool:
    return any(name.startswith(_PREFIXES) for name in tensors)


def _iterations_of_theirs(tensors: Collection[str]) -> dict[str, Any]:
    found = {m[1] for m in map(_ITERATION.match, tensors) if m}
    if len(found) > MOST_ITERATIONS:
        raise ValueError(f"it has {len(found):,} iterations, wanted at most {MOST_ITERATIONS}")
    return {"iterations": max(1, len(found))}


def _places(tensors: Collection[str]) -> dict[str, Place]:
    found = places_of(_LAYERS)
    for i in range(_iterations_of_theirs(tensors)["iterations"]):
        rows = [(theirs.format(i), *ours) for theirs, *ours in _LAYERS_PER_ITERATION]
        found |= places_of(rows, stacked=True)
    return found


_PARAMETERS = frozenset(place.path for place in _places(()).values())


def check_params(params: Any) -> None:
    """Raises ValueError unless all parameters of CFR are there, as arrays under their names."""
    wanted = "wanted the parameters of load_params"
    if not isinstance(params, Mapping):
        raise ValueError(f"params: got a {type(params).__name__}, {wanted}")
    try:
        found = flatten_dict(uncalibrated(params), sep="/")
    except (TypeError, AttributeError):  # names that are no text
        found = {}
    lacking = sorted(_PARAMETERS - found.keys())
    if lacking:
        some = "empty" if not params else f"without {lacking[0]}"
        raise ValueError(f"params: got a dict that is {some}, {wanted}")
    for name in sorted(_PARAMETERS):
        if not hasattr(found[name], "shape"):
            kind = type(found[name]).__name__
            raise ValueError(f"params: got a {kind} as {name}, {wanted}")


def parts(params: Params, settings: Settings) -> Callable[[Cloud, Cloud], Iterator[Part]]:
    """A function that yields all parts of the registration of two clouds, for timing."""
    network, count = bind(params), iterations_of(params)
    heavy = jax.jit(lambda cloud: heavy_features(network, cloud, settings))
    light = jax.jit(lambda *cloud: network.cascade.at_rest(*cloud))
    anneal = jax.jit(lambda *clouds: network.annealing(*clouds))
    matched = matching(settings.match)

    def of(source: Cloud, target: Cloud) -> Iterator[Part]:
        features = []
        for cloud, again in ((source, settings.repeat_extraction), (target, False)):
            points = np.asarray(cloud.points)
            k = min(settings.neighbors, len(points) - 1)
            yield Part(NEIGHBORS, on_host, (points, k, settings.radius))
            yield Part(FEATURES, heavy, (cloud,), count if again else 1)
            heavily = heavy(cloud)
            yield Part(FEATURES, light, (heavily, cloud.points))
            features.append(light(heavily, cloud.points))
        pair = source.points, target.points
        yield Part(ANNEALING, anneal, pair, count if settings.repeat_annealing else 1)
        beta, alpha = anneal(*pair)
        for i in range(count):
            passes = i + 1 if settings.passes is None else settings.passes
            given = (*(f[i] for f in features), beta[i], alpha[i], target.points, passes)
            yield Part(MATCHING, matched, given)
            yield Part(MOTION, move, (source.points, matched(*given)))

    return of


NETWORK = Network(
    name="cfr",
    title="CFR",
    settings=Settings,
    fresh=init_params,
    unroll=unroll,
    recognizes=_recognizes,
    arguments=_arguments,
    trained=_trained,
    validated=Settings(),
    iterations=iterations_of,
    variants=("shared",),
    # all but those set by the phases (neighbors), by training itself, and by its precision
    changeable=tuple(
        field.name
        for field in dataclasses.fields(Settings)
        if field.name not in ("neighbors", "detach_motion", "activations")
    ),
    parts=parts,
    checkpoint=Checkpoint(_theirs, _iterations_of_theirs, _places),
)
