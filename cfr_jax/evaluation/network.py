"""Our own method as a solver: in batches on clouds of one size, or through `align` on any."""

from __future__ import annotations

import functools
import time
from collections import defaultdict
from collections.abc import Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfr_jax import refinement
from cfr_jax.alignment import align
from cfr_jax.data.pairs import Pair
from cfr_jax.evaluation.methods import Answer, Solver, clouds_of
from cfr_jax.neighbors import nearest_on_host
from cfr_jax.normals import estimate_normals
from cfr_jax.registration import Cloud, Settings, register
from cfr_jax.weights import load_params

_SETTINGS = Settings()


def make_network(
    *,
    weights: str,
    refine: bool,
    through: Literal["register", "align"] = "register",
    estimated: bool = False,
    batch: int = 1,
    vectorized: int = 1,
    max_points: int | None = None,
    seed: int = 0,
) -> Solver:
    """The network of these weights, with or without refinement after its last iteration.

    "register" takes the clouds as they are, `batch` pairs a call, `vectorized` of them at a time
    (one keeps a CPU's caches warm, an accelerator wants many); the time of a pair is its share of
    the call's. "align" brings clouds of any size and place to the network's, pair by pair, with
    `max_points` and `seed` as `align` has them.
    """
    if through not in ("register", "align"):
        raise ValueError(f"through is {through!r}, wanted 'register' or 'align'")
    params = load_params(weights)
    if through == "align":
        return functools.partial(
            _align_each, params, refine, estimated, max_points=max_points, seed=seed
        )
    return functools.partial(_register_batches, params, refine, estimated, batch, vectorized)


def _align_each(
    params: dict, refine: bool, estimated: bool, pairs: Sequence[Pair], **options: Any
) -> list[Answer]:
    answers = []
    for pair in pairs:
        found = align(*clouds_of(pair, estimated), params=params, refine=refine, **options)
        transforms = found.transforms
        if refine:
            transforms = np.concatenate([transforms, found.transform[None]])
        answers.append(Answer(transforms, found.seconds["total"] - found.seconds["compile"]))
    return answers


def _register_batches(
    params: dict, refine: bool, estimated: bool, size: int, vectorized: int, pairs: Sequence[Pair]
) -> list[Answer]:
    """Clouds of different sizes go into different batches; a short batch repeats its last pair."""
    rows = defaultdict(list)
    for row, pair in enumerate(pairs):
        rows[len(pair.source), len(pair.target)].append(row)
    answers: dict[int, Answer] = {}
    for same in rows.values():
        for first in range(0, len(same), size):
            chosen = same[first : first + size]
            filled = chosen + [chosen[-1]] * (size - len(chosen))
            began = time.perf_counter()
            clouds = _stacked([pairs[row] for row in filled], estimated)
            prepared = time.perf_counter()
            program = _compiled(refine, vectorized, *_signature((params, *clouds)))
            compiled = time.perf_counter()
            transforms = np.asarray(jax.device_get(program(params, *clouds)), np.float64)
            seconds = prepared - began + time.perf_counter() - compiled
            answers |= {
                row: Answer(found, seconds / size)
                for row, found in zip(chosen, transforms, strict=False)
            }
    return [answers[row] for row in range(len(pairs))]


def _stacked(pairs: Sequence[Pair], estimated: bool) -> list[Cloud]:
    """Sources and targets as batches, neighbors found on the host."""
    sides = zip(*(clouds_of(pair, estimated) for pair in pairs), strict=True)
    stacked = []
    for clouds in sides:
        points = [cloud.points.astype(np.float32) for cloud in clouds]
        normals = [cloud.normals for cloud in clouds]
        without = [cloud.name for cloud in clouds if cloud.normals is None]
        if without and len(without) < len(clouds):
            raise ValueError("of one batch all clouds have normals or none; set batch to 1")
        k = min(_SETTINGS.neighbors, len(points[0]) - 1)
        found = [nearest_on_host(cloud, k, radius=_SETTINGS.radius) for cloud in points]
        stacked.append(
            Cloud(
                points=jnp.asarray(np.stack(points)),
                normals=None if without else jnp.asarray(np.stack(normals), jnp.float32),
                neighbors=jnp.asarray(np.stack(found)),
            )
        )
    return stacked


@functools.partial(jax.jit, static_argnames=("refine", "vectorized"))
def _solve(
    params: dict, sources: Cloud, targets: Cloud, *, refine: bool, vectorized: int
) -> Float[Array, "b i 4 4"]:
    def of_pair(pair):
        source, target = (_with_normals(cloud) for cloud in pair)
        transforms = register(params, source, target, settings=_SETTINGS).transforms
        if not refine:
            return transforms
        surfaces = (
            refinement.Surface(cloud.points, cloud.normals, jnp.ones(len(cloud.points), bool))
            for cloud in (source, target)
        )
        refined = refinement.refine(*surfaces, transforms[-1]).transform
        return jnp.concatenate([transforms, refined[None]])

    size = vectorized if vectorized > 1 else None
    return jax.lax.map(of_pair, (sources, targets), batch_size=size)


def _with_normals(cloud: Cloud) -> Cloud:
    if cloud.normals is not None:
        return cloud
    return cloud.replace(normals=estimate_normals(cloud.points, cloud.neighbors))


def _signature(arguments: Any) -> tuple:
    leaves, structure = jax.tree.flatten(arguments)
    return structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves)


@functools.cache
def _compiled(refine: bool, vectorized: int, structure: Any, shapes: tuple) -> Any:
    """Compiled ahead, so that the time of a call holds no compilation."""
    arguments = jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(*shape) for shape in shapes])
    return _solve.lower(*arguments, refine=refine, vectorized=vectorized).compile()
