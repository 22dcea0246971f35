"""How long the parts of a network take, each compiled alone (figure 6 of the paper).

A part is run on the clouds of a pair as often as a registration runs it. The parts are those of the
network as it is; their sum is a little more than a whole registration, compiled as one program.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cfr_jax.data.pairs import Pair
from cfr_jax.evaluation.methods import clouds_of
from cfr_jax.geometry import rigid
from cfr_jax.geometry.neighbors import nearest_on_host
from cfr_jax.geometry.normals import estimate_normals
from cfr_jax.networks import rpmnet
from cfr_jax.networks.cfr.iterations import bind, iterations_of
from cfr_jax.networks.features import raw_features
from cfr_jax.networks.inputs import Cloud, Settings
from cfr_jax.networks.sinkhorn import Affinity, match
from cfr_jax.weights.files import load_params

NEIGHBORS, FEATURES, ANNEALING = "neighbors", "features", "annealing"
MATCHING, MOTION = "matching and Sinkhorn", "Procrustes"
_REPEATS = 3


class Part(NamedTuple):
    """A function that the registration of a pair calls so many times."""

    module: str
    function: Callable[..., Any]
    arguments: tuple
    times: int = 1


def make_modules(
    network: str, weights: str, settings: dict[str, Any] | None, estimated: bool
) -> Callable[[Sequence[Pair]], list[dict[str, float]]]:
    """What tells the seconds of each module, for every pair given to it."""
    params = load_params(weights, network)
    if network == "rpmnet":
        parts = _Rpmnet(params, rpmnet.RPMNetSettings(**settings or {}))
    else:
        parts = _Cfr(params, Settings(**settings or {}))
    return lambda pairs: [seconds_of(parts.of(*_clouds(pair, estimated))) for pair in pairs]


def seconds_of(parts: Iterator[Part]) -> dict[str, float]:
    """Seconds of each module: the quickest of some runs, device-synchronized, compiled before."""
    seconds: dict[str, float] = defaultdict(float)
    for part in parts:
        jax.block_until_ready(part.function(*part.arguments))
        runs = []
        for _ in range(_REPEATS):
            began = time.perf_counter()
            jax.block_until_ready(part.function(*part.arguments))
            runs.append(time.perf_counter() - began)
        seconds[part.module] += part.times * min(runs)
    return dict(seconds)


class _Cfr:
    def __init__(self, params: dict, settings: Settings):
        self.settings, self.count = settings, iterations_of(params)
        network = bind(params)
        self.heavy = jax.jit(lambda cloud: _raw_cfr(network, cloud, settings))
        self.light = jax.jit(lambda *cloud: network.cascade.at_rest(*cloud))
        self.annealing = jax.jit(lambda *clouds: network.annealing(*clouds))
        self.match = _matching(settings.match)

    def of(self, source: Cloud, target: Cloud) -> Iterator[Part]:
        """All parts of the registration of these clouds."""
        settings, count = self.settings, self.count
        features = []
        for cloud, again in ((source, settings.repeat_extraction), (target, False)):
            points = np.asarray(cloud.points)
            k = min(settings.neighbors, len(points) - 1)
            yield Part(NEIGHBORS, lambda p, k=k: _on_host(p, k, settings.radius), (points,))
            yield Part(FEATURES, self.heavy, (cloud,), count if again else 1)
            heavy = self.heavy(cloud)
            yield Part(FEATURES, self.light, (heavy, cloud.points))
            features.append(self.light(heavy, cloud.points))
        pair = source.points, target.points
        yield Part(ANNEALING, self.annealing, pair, count if settings.repeat_annealing else 1)
        beta, alpha = self.annealing(*pair)
        for i in range(count):
            passes = i + 1 if settings.passes is None else settings.passes
            matched = (*(f[i] for f in features), beta[i], alpha[i], target.points, passes)
            yield Part(MATCHING, self.match, matched)
            yield Part(MOTION, _move, (source.points, self.match(*matched)))


class _Rpmnet:
    def __init__(self, params: dict, settings: rpmnet.RPMNetSettings):
        self.settings = settings
        network = rpmnet.bind(params)
        self.search = jax.jit(lambda cloud: rpmnet.find_neighbors(cloud, settings))
        self.extract = jax.jit(lambda cloud, ball: rpmnet.extract(network, cloud, ball))
        self.annealing = jax.jit(lambda *clouds: network.annealing(*clouds))
        self.match = _matching("auto" if settings.optimized else "log space")

    def of(self, source: Cloud, target: Cloud) -> Iterator[Part]:
        """All parts of the registration of these clouds."""
        count = self.settings.iterations
        features = []
        for cloud in (source, target):
            yield Part(NEIGHBORS, self.search, (cloud,), 1 if self.settings.optimized else count)
            ball = self.search(cloud)
            yield Part(FEATURES, self.extract, (cloud, ball), count)
            features.append(self.extract(cloud, ball))
        pair = source.points, target.points
        yield Part(ANNEALING, self.annealing, pair, count)
        beta, alpha = self.annealing(*pair)
        matched = (*features, beta[0], alpha[0], target.points, self.settings.passes)
        yield Part(MATCHING, self.match, matched, count)
        yield Part(MOTION, _move, (source.points, self.match(*matched)), count)


def _raw_cfr(network, cloud, settings):
    raw = raw_features(cloud.points, cloud.normals, cloud.neighbors, ppf=settings.ppf)
    return network.features(raw)


def _on_host(points, k, radius):
    return nearest_on_host(points, k, radius=radius)


def _matching(form):
    def matched(source, target, beta, alpha, points, passes):
        return match(Affinity(source, target, beta, alpha), points, passes=passes, form=form)

    return jax.jit(matched, static_argnums=5)


@jax.jit
def _move(points, match):
    return rigid.apply(rigid.fit_rigid(points, match.targets, match.weights), points)


def _clouds(pair: Pair, estimated: bool) -> list[Cloud]:
    """The clouds as the networks take them; estimating normals belongs to no module."""
    found = []
    for cloud in clouds_of(pair, estimated):
        points = jnp.asarray(cloud.points, jnp.float32)
        k = min(Settings().neighbors, len(points) - 1)
        neighbors = jnp.asarray(nearest_on_host(np.asarray(points), k, radius=Settings().radius))
        normals = estimate_normals(points, neighbors)
        if cloud.normals is not None:
            normals = jnp.asarray(cloud.normals, jnp.float32)
        found.append(Cloud(points, normals, neighbors))
    return found
