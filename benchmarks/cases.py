"""The cases measured in this process: whole registrations, modules, the paper's speed-ups, batches.

A case has a name, an amount of arithmetic, and a function that makes the call to measure. Making
the call may compile.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import clouds
import cost
import jax
import jax.numpy as jnp
from timing import compiled, program

import cfr_jax as cfr
from cfr_jax.geometry import rigid
from cfr_jax.geometry.neighbors import nearest, nearest_on_host
from cfr_jax.networks import rpmnet, sinkhorn
from cfr_jax.networks.cfr import iterations, registration
from cfr_jax.networks.features import raw_features

Call = Callable[[], object]
PAPER = 717
SETTINGS = cfr.Settings()


@dataclass(frozen=True)
class Case:
    """One thing to measure."""

    group: str
    name: str
    points: int
    make: Callable[[], tuple[Call, float]]
    """Returns the call, and the seconds that compiling it took."""
    flop: float | None = None
    batch: int = 1
    settings: dict = field(default_factory=dict)


def search(points):
    """Neighbors on the host, as `align` finds them."""
    return nearest_on_host(points, SETTINGS.neighbors, radius=SETTINGS.radius)


def prepared(count: int) -> tuple[registration.Cloud, registration.Cloud]:
    """Both clouds on the device, with neighbors and estimated normals."""
    x, y = (cfr.prepare(cloud, neighbors=search(cloud)) for cloud in clouds.pair(count))
    return x, y


def whole(sizes: tuple[int, ...]) -> Iterator[Case]:
    """From two arrays in host memory to the motion: neighbors, normals, network."""
    params = cfr.load_params()

    def make(count):
        x, y = clouds.pair(count)
        prepare, first = program(lambda p, n: cfr.prepare(p, neighbors=n), x, search(x))
        a, b = prepare(x, search(x)), prepare(y, search(y))
        solve, second = program(lambda a, b: registration.register(params, a, b), a, b)
        return lambda: solve(prepare(x, search(x)), prepare(y, search(y))), first + second

    for count in sizes:
        yield Case(
            "whole pair", "register", count, lambda c=count: make(c), cost.pair(count, count)
        )


def modules(count: int) -> Iterator[Case]:
    """Each module alone, on both clouds if both pass through it."""
    params = cfr.load_params()
    x, y = clouds.pair(count)
    a, b = prepared(count)
    network = iterations.bind(params)
    raw = [raw_features(c.points, c.normals, c.neighbors) for c in (a, b)]
    base = [network.features(channels) for channels in raw]
    rows = [network.cascade.at_rest(f, c.points) for f, c in zip(base, (a, b), strict=True)]
    narrow = jax.tree.map(lambda leaf: leaf.astype(jnp.bfloat16), (params, raw))

    def case(name, flop, function, *arguments, group="modules"):
        return Case(group, name, count, lambda: compiled(function, *arguments), flop)

    def features(params, raw):
        return [iterations.bind(params).features(channels) for channels in raw]

    def matched(rows):
        return [
            sinkhorn.match(
                sinkhorn.Affinity(rows[0][i], rows[1][i], jnp.float32(12), jnp.float32(0.3)),
                y,
                passes=i + 1,
            )
            for i in range(len(rows[0]))
        ]

    def tops(points):
        square = jnp.sum((points[:, None] - points[None]) ** 2, axis=-1)
        return jax.lax.top_k(-square, SETTINGS.neighbors + 1)[1]

    def by_svd(x, y):
        u, _, vt = jnp.linalg.svd((x - x.mean(0)).T @ (y - y.mean(0)))
        return vt.T @ u.T

    mlp = 2 * cost.features(count)
    match = cost.match(count, count)
    light = 2 * cost.cascade(count)
    yield Case(
        "modules", "neighbors, on the host", count, lambda: (lambda: list(map(search, (x, y))), 0.0)
    )
    yield case(
        "neighbors, on the device",
        None,
        lambda x, y: [nearest(p, 64, radius=0.3) for p in (x, y)],
        x,
        y,
    )
    yield case("neighbors, by top_k", None, lambda x, y: [tops(p) for p in (x, y)], x, y)
    yield case(
        "raw channels",
        None,
        lambda a, b: [raw_features(c.points, c.normals, c.neighbors) for c in (a, b)],
        a,
        b,
    )
    yield case("features (MLP)", mlp, features, params, raw)
    yield case("features (MLP), bfloat16", mlp, features, *narrow)
    yield case(
        "cascade",
        light,
        lambda f, a, b: [
            network.cascade.at_rest(g, c.points) for g, c in zip(f, (a, b), strict=True)
        ],
        base,
        a,
        b,
    )
    yield case("annealing", cost.annealing(count, count), network.annealing, x, y)
    yield case("match and Sinkhorn", match, matched, rows)
    yield case(
        "Procrustes, five",
        None,
        lambda x, y: [rigid.fit_rigid(x * (1 + i), y, x[:, 0] ** 2) for i in range(5)],
        x,
        y,
    )
    yield case(
        "Procrustes, five, by SVD",
        None,
        lambda x, y: [by_svd(x * (1 + i), y) for i in range(5)],
        x,
        y,
    )


# The work that the paper saves; each case adds back one part of it.
ABLATIONS = {
    "as it is": {},
    "features again in every iteration": {"repeat_extraction": True},
    "annealing again in every iteration": {"repeat_annealing": True},
    "Sinkhorn in log space": {"match": "log space"},
    "five Sinkhorn passes everywhere": {"passes": 5},
    "Sinkhorn streamed": {"match": "streamed"},
}


def ablations(count: int) -> Iterator[Case]:
    """The network on prepared clouds, with one of the paper's speed-ups turned off at a time."""
    params = cfr.load_params()
    for name, options in ABLATIONS.items():
        settings = dataclasses.replace(SETTINGS, **options)

        def make(settings=settings):
            return compiled(
                lambda a, b: registration.register(params, a, b, settings=settings),
                *prepared(count),
            )

        yield Case("speed-ups off", name, count, make, cost.pair(count, count), settings=options)


def networks(count: int) -> Iterator[Case]:
    """Our RPM-Net, published and optimized, with fresh parameters (they do not affect the time)."""
    params = rpmnet.init_params(jax.random.key(0))
    for name, optimized in (("RPM-Net (Optim), ours", True), ("RPM-Net as published, ours", False)):
        settings = rpmnet.RPMNetSettings(optimized=optimized)

        def make(settings=settings):
            return compiled(
                lambda a, b: [s.transform for s in rpmnet.unroll(params, a, b, settings)],
                *prepared(count),
            )

        yield Case("peers", name, count, make)


def batches(count: int, sizes: tuple[int, ...]) -> Iterator[Case]:
    """The network on a batch of prepared pairs, with `vmap`."""
    params = cfr.load_params()
    flop = cost.pair(count, count)

    def make(size):
        stacked = [
            jax.tree.map(lambda leaf: jnp.stack([leaf] * size), cloud) for cloud in prepared(count)
        ]
        return compiled(jax.vmap(lambda a, b: registration.register(params, a, b)), *stacked)

    for size in sizes:
        yield Case("batches", f"batch {size}", count, lambda s=size: make(s), size * flop, size)
