"""`align_many`: `align` for any number of pairs."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from cfr_jax.alignment.align import checked_params, chosen_refinements
from cfr_jax.alignment.answers import Alignment
from cfr_jax.alignment.planning import DEFAULT_BUDGET, Plan, whole_number
from cfr_jax.alignment.scaling.planning import Scale, checked_scale, planned_at_scale
from cfr_jax.alignment.solving import on_accelerator
from cfr_jax.batch.device import Device, Signature, signature
from cfr_jax.batch.memo import Memo
from cfr_jax.geometry import units
from cfr_jax.io import PointCloud, as_point_cloud
from cfr_jax.networks.record import Params
from cfr_jax.refine import Refine
from cfr_jax.runtime.entries import entry

# More pairs per call keep an accelerator busy, but do not fit in a CPU's caches.
ON_CPU, ON_ACCELERATOR = 1, 16
_TARGET_CLOUDS = 4  # whole clouds from files, which may be large
_TARGET_UNITS = 64
_MOST_WAITING = 8  # this many batches of pairs may wait before a batch is solved that is not full


@dataclass(frozen=True)
class Outcome:
    """The result for one pair: an alignment or an error."""

    index: int
    """Position of the pair in the input, from 0."""
    alignment: Alignment | None
    error: str | None
    """Why there is no alignment."""


@entry
def align_many(
    pairs: Iterable[Any],
    *,
    params: Params | None = None,
    refine: Refine = True,
    max_points: int | None = None,
    all_points: bool = True,
    second_look: bool = True,
    scale: Scale = 1.0,
    seed: int = 0,
    batch: int | None = None,
    workers: int | None = None,
    ordered: bool = True,
) -> Iterator[Outcome]:
    """Aligns a stream of pairs and yields one `Outcome` for each.

    A pair is `(source, target)` or `(source, target, initial)`. Clouds are what `align` takes, and
    `initial` is one (4, 4) start; a search of all rotations needs `align`. A pair may also be a
    function without arguments that returns such a tuple; it is called when its turn comes.

    `workers` threads read and prepare pairs ahead of time (default: one per core, at most 4). Pairs
    of one padded size are solved together, `batch` at a time, by one `vmap` of the program
    (default: 1 on a CPU, 16 on an accelerator). A target that several sources share, as the same
    file or with the same points, is read and encoded once while it is among the last ones used.

    With `ordered`, outcomes come in the order of the pairs. Otherwise they come as soon as they are
    done. The answers equal those of `align` up to float32 rounding. A `second_look` and the last
    refinement, on `all_points`, run pair by pair. `refine` may name any refinement that JAX can
    trace. If a pair cannot be read or has no answer, its outcome has an `error`, and the others
    continue. `scale` is that of `align`, for all pairs. Do not change an array before its outcome
    has come.

    Raises ValueError for invalid options, before it reads any pair.
    """
    budget = DEFAULT_BUDGET
    if max_points is not None:
        budget = whole_number("max_points", max_points, least=3)
    seed = whole_number("seed", seed, least=0)
    if batch is None:
        batch = ON_ACCELERATOR if on_accelerator() else ON_CPU
    if workers is None:
        workers = min(4, os.cpu_count() or 1)
    weights = checked_params(params)
    refinements = chosen_refinements(refine, all_points=all_points)
    if refinements and not refinements[0].traceable:
        raise ValueError(
            f"refine: got {refine!r}, which runs on the host; wanted True, False or one that JAX "
            "can trace. `align` takes any, pair by pair"
        )
    checked_scale(scale, None)
    device = Device(weights, refinements, second_look, whole_number("batch", batch, least=1))
    workers = whole_number("workers", workers, least=1)
    done = _done(
        _Planner(weights, scale, budget, seed, len(refinements) > 1), pairs, device, workers
    )
    return _in_order(done) if ordered else done


class _Planner:
    """Prepares pairs, on many threads at once; repeated targets are prepared only once."""

    def __init__(self, params: Params, scale: Scale, budget: int, seed: int, whole: bool):
        self._params, self._scale = params, scale
        self._budget, self._seed, self._whole = budget, seed, whole
        self._clouds, self._units = Memo(_TARGET_CLOUDS), Memo(_TARGET_UNITS)

    def __call__(self, pair: Any) -> Plan:
        source, target, initial = _unpacked(pair() if callable(pair) else pair)
        if isinstance(target, (str, os.PathLike)):
            place = os.path.realpath(target)
            target = self._clouds.get(place, lambda: as_point_cloud(target, name="target"))

        def to_unit(cloud: PointCloud, *place: Any, **options: Any) -> units.UnitCloud:
            def make() -> tuple[PointCloud, units.UnitCloud]:
                return cloud, units.to_unit(cloud, *place, **options)

            if cloud is not target:
                return make()[1]
            center, scale, motion = place
            # the value keeps the cloud alive, so that no other cloud can get its id
            key = id(cloud), center.tobytes(), scale, motion.tobytes()
            return self._units.get(key, make)[1]

        plan = planned_at_scale(
            self._params,
            source,
            target,
            scale=self._scale,
            initial=initial,
            to_unit=to_unit,
            max_points=self._budget,
            seed=self._seed,
            whole=self._whole,
            search=not on_accelerator(),
        )
        if plan.starts is not None:
            raise ValueError(
                "initial: got several starts, wanted one (4, 4); only `align` can search"
            )
        return plan


def _done(plan: _Planner, pairs: Iterable[Any], device: Device, workers: int) -> Iterator[Outcome]:
    """Yields outcomes as they come; if many pairs wait, solves the batch with the oldest first."""
    waiting: dict[Signature, list[tuple[int, Plan]]] = {}

    def solve(key: Signature) -> Iterator[Outcome]:
        rows, plans = zip(*waiting.pop(key), strict=True)
        for row, alignment in zip(rows, device.solve(plans), strict=True):
            yield Outcome(row, alignment, None)

    for index, future in _ahead(plan, pairs, workers, 2 * device.size + workers):
        try:
            ready = future.result()
        except Exception as error:  # whatever is in a file, only this pair fails
            yield Outcome(index, None, _reason(error))
            continue
        key = signature(ready)
        waiting.setdefault(key, []).append((index, ready))
        if len(waiting[key]) == device.size:
            yield from solve(key)
        elif sum(map(len, waiting.values())) >= _MOST_WAITING * device.size:
            yield from solve(min(waiting, key=lambda key: waiting[key][0][0]))
    while waiting:
        yield from solve(next(iter(waiting)))


def _ahead(
    plan: Callable[[Any], Plan], pairs: Iterable[Any], workers: int, most: int
) -> Iterator[tuple[int, Future]]:
    """Yields the plan of each pair, in order; starts up to `most` of them ahead of time."""
    pool = ThreadPoolExecutor(workers, thread_name_prefix="cfr-read")
    begun: deque[tuple[int, Future]] = deque()
    try:
        for index, pair in enumerate(pairs):
            begun.append((index, pool.submit(plan, pair)))
            if len(begun) >= most:
                yield begun.popleft()
        while begun:
            yield begun.popleft()
    finally:  # also if the caller stops early
        pool.shutdown(cancel_futures=True)


def _in_order(outcomes: Iterator[Outcome]) -> Iterator[Outcome]:
    early: dict[int, Outcome] = {}
    next_index = 0
    for outcome in outcomes:
        early[outcome.index] = outcome
        while next_index in early:
            yield early.pop(next_index)
            next_index += 1


def _unpacked(pair: Any) -> tuple[Any, Any, Any]:
    if not isinstance(pair, (tuple, list)) or len(pair) not in (2, 3):
        count = f" of {len(pair)}" if isinstance(pair, (tuple, list)) else ""
        raise ValueError(
            f"pair: got a {type(pair).__name__}{count}, wanted (source, target) or "
            "(source, target, initial)"
        )
    return (*pair, None)[:3]


def _reason(error: Exception) -> str:
    if isinstance(error, (ValueError, OSError)):
        return str(error)
    return f"{type(error).__name__}: {error}"
