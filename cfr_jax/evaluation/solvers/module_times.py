"""How long the parts of a network take, each compiled alone (figure 6 of the paper).

The time of a part counts as often as a registration of the pair runs it. The sum of all parts is a
little more than a whole registration, which is compiled as one program.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cfr_jax.data.pairs import Pair
from cfr_jax.evaluation.solvers.solver import clouds_of
from cfr_jax.geometry.neighbors import nearest_on_host
from cfr_jax.geometry.normals import estimate_normals
from cfr_jax.networks import table
from cfr_jax.networks.inputs import Cloud, Settings
from cfr_jax.networks.record import Network, Part
from cfr_jax.weights.files import load_params

_REPEATS = 3


def make_modules(
    network: Network, weights: str, settings: dict[str, Any] | None, estimated: bool
) -> Callable[[Sequence[Pair]], list[dict[str, float]]]:
    """A function that returns the seconds of each module, for every pair it is given.

    Raises ValueError for a network whose record names no parts.
    """
    if network.parts is None:
        raise ValueError(f"modules: the record of {network.title} names no parts to time")
    table.have(network)
    params = load_params(weights, network.name)
    parts = network.parts(params, network.settings(**settings or {}))
    return lambda pairs: [seconds_of(parts(*_clouds(pair, estimated))) for pair in pairs]


def seconds_of(parts: Iterator[Part]) -> dict[str, float]:
    """Seconds of each module: the fastest of some synchronized runs, without compilation."""
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


def _clouds(pair: Pair, estimated: bool) -> list[Cloud]:
    """The clouds as the networks take them; estimating normals is not part of any module."""
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
