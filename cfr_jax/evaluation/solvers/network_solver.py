"""The networks as solvers: in batches for clouds of one size, or pair by pair for any size."""

from __future__ import annotations

import functools
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfr_jax.alignment import solving
from cfr_jax.alignment.align import align
from cfr_jax.alignment.planning import planned
from cfr_jax.data.pairs import Pair
from cfr_jax.evaluation.solvers.solver import Answer, Solver, clouds_of
from cfr_jax.geometry import rigid
from cfr_jax.geometry.neighbors import nearest_on_host
from cfr_jax.geometry.normals import estimate_normals
from cfr_jax.networks import table
from cfr_jax.networks.inputs import Cloud, Settings, moved_by
from cfr_jax.networks.record import Network, Params
from cfr_jax.refine import Refinement, find
from cfr_jax.runtime import programs
from cfr_jax.weights.files import load_params


@dataclass(frozen=True)
class Program:
    """Everything that is static in the compiled program."""

    network: Network
    settings: Any
    refine: Refinement | None
    vectorized: int
    cascades: int = 1


def make_network(
    *,
    network: Network,
    weights: str,
    refine: bool | str = False,
    settings: dict[str, Any] | None = None,
    through: Literal["register", "align", "preparation"] = "register",
    estimated: bool = False,
    batch: int = 1,
    vectorized: int = 1,
    cascades: int = 1,
    max_points: int | None = None,
    initial: Literal["global", "auto"] | None = None,
    seed: int = 0,
) -> Solver:
    """A solver that runs a network with these weights.

    `settings` replace its usual ones, `refine` adds a refinement after the last iteration, and it
    runs `cascades` times, each starting where the one before it ended.

    With `through="register"` it takes the clouds as they are, `batch` pairs per call, `vectorized`
    of them at a time (one at a time keeps a CPU's caches warm, an accelerator wants many). The time
    of a pair is its share of the call. "align" (CFR only) is `align`, pair by pair, with its
    `max_points`, `initial` and `seed`. "preparation" works for any network: it scales and centers
    clouds for the network as `align` does. Raises ValueError for options that do not go together.
    """
    if through not in ("register", "align", "preparation"):
        raise ValueError(f"through is {through!r}, wanted 'register', 'align' or 'preparation'")
    if cascades < 1:
        raise ValueError(f"cascades is {cascades}, wanted at least 1")
    table.have(network)  # in a new process, the table has only the networks of the package
    params = load_params(weights, network.name)
    if through == "align":
        if network.name != "cfr" or settings or cascades != 1:
            raise ValueError(
                "through is 'align', which is only for CFR with its usual settings and one "
                "cascade; wanted 'preparation' for anything else"
            )
        return functools.partial(
            _align_each,
            params,
            refine,
            estimated,
            max_points=max_points,
            initial=initial,
            seed=seed,
        )
    if initial is not None:
        raise ValueError(f"initial is {initial!r}, which needs through='align'")
    refinement = find(refine)
    if refinement is not None and not refinement.traceable:
        raise ValueError(f"refine is {refine!r}, which needs through='align'")
    made = network.settings(**settings or {})
    program = Program(network, made, refinement, vectorized, cascades)
    if through == "preparation":
        return functools.partial(_prepare_each, params, program, estimated, max_points, seed)
    return functools.partial(_register_batches, params, program, estimated, batch)


def _align_each(
    params: Params, refine: bool | str, estimated: bool, pairs: Sequence[Pair], **options: Any
) -> list[Answer]:
    answers = []
    for pair in pairs:
        found = align(*clouds_of(pair, estimated), params=params, refine=refine, **options)
        transforms = found.transforms
        if refine:
            transforms = np.concatenate([transforms, found.transform[None]])
        answers.append(Answer(transforms, found.seconds["total"] - found.seconds["compile"]))
    return answers


def _prepare_each(
    params: Params,
    program: Program,
    estimated: bool,
    max_points: int | None,
    seed: int,
    pairs: Sequence[Pair],
) -> list[Answer]:
    unit = Settings(program.settings.neighbors, program.settings.radius)
    answers = []
    for pair in pairs:
        clouds = clouds_of(pair, estimated)
        began = time.perf_counter()
        plan = planned(*clouds, max_points=max_points, seed=seed, settings=unit)
        batches = [
            Cloud(
                jnp.asarray(cloud.points)[None],
                _unless_missing(None if cloud.normals is None else cloud.normals[None]),
                jnp.asarray(cloud.neighbors)[None],
                jnp.asarray(cloud.mask)[None],
            )
            for cloud in (plan.source, plan.target)
        ]
        found, compiling = _run(program, params, *batches)
        seconds = time.perf_counter() - began - compiling
        answers.append(Answer(plan.frames.to_caller(found[0]), seconds))
    return answers


def _register_batches(
    params: Params, program: Program, estimated: bool, size: int, pairs: Sequence[Pair]
) -> list[Answer]:
    """Batches hold clouds of the same size; a short batch repeats its last pair."""
    rows = defaultdict(list)
    for row, pair in enumerate(pairs):
        rows[len(pair.source), len(pair.target)].append(row)
    answers: dict[int, Answer] = {}
    for same in rows.values():
        for first in range(0, len(same), size):
            chosen = same[first : first + size]
            filled = chosen + [chosen[-1]] * (size - len(chosen))
            began = time.perf_counter()
            clouds = _stacked(program, [pairs[row] for row in filled], estimated)
            transforms, compiling = _run(program, params, *clouds)
            seconds = time.perf_counter() - began - compiling
            answers |= {
                row: Answer(found, seconds / size)
                for row, found in zip(chosen, transforms, strict=False)
            }
    return [answers[row] for row in range(len(pairs))]


def _stacked(program: Program, pairs: Sequence[Pair], estimated: bool) -> list[Cloud]:
    """Sources and targets as batches; neighbors are searched on the host if they are needed."""
    settings = program.settings
    sides = zip(*(clouds_of(pair, estimated) for pair in pairs), strict=True)
    stacked = []
    for clouds in sides:
        points = [cloud.points.astype(np.float32) for cloud in clouds]
        normals = [cloud.normals for cloud in clouds]
        without = [cloud.name for cloud in clouds if cloud.normals is None]
        if without and len(without) < len(clouds):
            raise ValueError(
                "batch: got some clouds with normals and some without, wanted all or none in one "
                "batch; set batch to 1"
            )
        k = min(settings.neighbors, len(points[0]) - 1)
        if program.network.own_neighbors and not without:
            found = [np.zeros((len(cloud), 1), np.int32) for cloud in points]
        else:
            found = [nearest_on_host(cloud, k, radius=settings.radius) for cloud in points]
        stacked.append(
            Cloud(
                points=jnp.asarray(np.stack(points)),
                normals=_unless_missing(None if without else np.asarray(normals, np.float32)),
                neighbors=jnp.asarray(np.stack(found)),
            )
        )
    return stacked


def _run(
    program: Program, params: Params, sources: Cloud, targets: Cloud
) -> tuple[Float[np.ndarray, "b i 4 4"], float]:
    """The motions of a batch, in host memory, and the seconds that compilation took."""
    began = time.perf_counter()
    compiled = programs.compiled(_solve, params, sources, targets, program=program)
    compiling = time.perf_counter() - began
    found = jax.device_get(compiled(params, sources, targets))
    return np.asarray(found, np.float64), compiling


@functools.partial(jax.jit, static_argnames=("program",))
def _solve(
    params: Params, sources: Cloud, targets: Cloud, *, program: Program
) -> Float[Array, "b i 4 4"]:
    def of_pair(pair: tuple[Cloud, Cloud]) -> Array:
        source, target = (_with_normals(cloud) for cloud in pair)
        transforms = _transforms(program, params, source, target)
        if program.refine is None:
            return transforms
        surfaces = solving.surface(source), solving.surface(target)
        refined = program.refine(*surfaces, transforms[-1]).transform
        return jnp.concatenate([transforms, refined[None]])

    size = program.vectorized if program.vectorized > 1 else None
    return jax.lax.map(of_pair, (sources, targets), batch_size=size)


def _transforms(
    program: Program, params: Params, source: Cloud, target: Cloud
) -> Float[Array, "i 4 4"]:
    """The motions of all cascades; each cascade starts where the one before it ended."""

    def cascade(start: Array, _: None) -> tuple[Array, Array]:
        steps = program.network.unroll(params, moved_by(start, source), target, program.settings)
        transforms = jnp.stack([rigid.compose(step.transform, start) for step in steps])
        return transforms[-1], transforms

    start = jnp.eye(4, dtype=jnp.float32)  # like the clouds of `_stacked`
    return jax.lax.scan(cascade, start, length=program.cascades)[1].reshape(-1, 4, 4)


def _unless_missing(normals: np.ndarray | None) -> Any:
    """The normals on the device. A `Cloud` holds None only until `_with_normals` replaces it."""
    return None if normals is None else jnp.asarray(normals)


def _with_normals(cloud: Cloud) -> Cloud:
    if cloud.normals is not None:
        return cloud
    return cloud.replace(normals=estimate_normals(cloud.points, cloud.neighbors, cloud.mask))
