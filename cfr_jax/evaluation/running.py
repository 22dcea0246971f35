"""Runs a method on pairs: in batches, with a progress bar; can resume, and survives failures."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from cfr_jax.data.pairs import Pair
from cfr_jax.evaluation import machine, store
from cfr_jax.evaluation.methods import Method
from cfr_jax.evaluation.solvers.solver import Answer
from cfr_jax.evaluation.store import Record, Records
from cfr_jax.evaluation.worker import Failed, Missing, Worker
from cfr_jax.geometry.motions import are_rigid

_SAVE_EVERY = 5.0  # seconds
_MODULE_PAIRS = 9


def run_method(method: Method, pairs: Sequence[Pair], path: Path, timeout: float) -> Records:
    """The records of all pairs; those already in `path` are not made again.

    If a method raises an error, crashes, takes more than `timeout` seconds, or returns something
    that is not a rigid motion, it fails on that pair and continues with the next. If a batch fails,
    each of its pairs is tried alone.
    """
    if method.missing is not None:
        tqdm.write(f"{method.name} is left out: {method.missing}")
        return Records(method.about, missing=method.missing)
    digests = [store.digest(pair) for pair in pairs]
    held = store.load(path, method.about, digests)
    # The method must not see the whole shapes.
    given = [dataclasses.replace(pair, clean_source=None, clean_target=None) for pair in pairs]
    todo = [index for index in range(len(pairs)) if index not in held.by_pair]
    saved = time.monotonic()
    with (
        Worker(method) as worker,
        tqdm(
            total=len(pairs), desc=method.name, initial=len(pairs) - len(todo), disable=None
        ) as bar,
    ):
        for first in range(0, len(todo), method.batch):
            rows = todo[first : first + method.batch]
            try:
                for row, record in _solve(worker, rows, given, digests, timeout):
                    held.by_pair[row] = record
                    if record.failure:
                        bar.write(f"{method.name} failed on pair {row}: {record.failure}")
            except Missing as error:
                held.missing = str(error)
                bar.write(f"{method.name} is left out: {error}")
                return held
            if worker.started and held.started is None:
                held.started = dataclasses.asdict(worker.started) | machine.stamp()
            bar.update(len(rows))
            if time.monotonic() - saved > _SAVE_EVERY:
                store.save(path, held)
                saved = time.monotonic()
    held.by_pair = dict(sorted(held.by_pair.items()))
    if method.modules is not None and held.modules is None:
        held.modules = _time_modules(method, given[:_MODULE_PAIRS], timeout)
    store.save(path, held)
    return held


def _time_modules(method: Method, pairs: Sequence[Pair], timeout: float) -> dict[str, float] | None:
    """Seconds per pair of each part of the method (medians of some pairs); None if that fails."""
    modules: Any = method.modules  # a worker passes on any answer, here seconds
    timed = dataclasses.replace(method, make=modules)
    try:
        with Worker(timed) as worker:
            found: Any = worker.solve(pairs, timeout)
    except (Failed, Missing) as error:
        tqdm.write(f"{method.name}: its modules were not timed: {error}")
        return None
    return {name: float(np.median([each[name] for each in found])) for name in found[0]}


def _solve(
    worker: Worker,
    rows: Sequence[int],
    pairs: Sequence[Pair],
    digests: Sequence[str],
    timeout: float,
) -> Iterator[tuple[int, Record]]:
    try:
        answers = worker.solve([pairs[row] for row in rows], timeout)
    except Failed as error:
        if len(rows) == 1:
            yield rows[0], Record(digests[rows[0]], failure=str(error))
            return
        for row in rows:
            yield from _solve(worker, [row], pairs, digests, timeout)
        return
    for row, answer in zip(rows, answers, strict=True):
        yield row, _record(digests[row], answer)


def _record(pair: str, answer: Answer) -> Record:
    transforms = np.asarray(answer.transforms, np.float64)
    if transforms.ndim != 3 or transforms.shape[1:] != (4, 4) or not len(transforms):
        return Record(pair, failure=f"returned an array {transforms.shape}, wanted (i, 4, 4)")
    if not are_rigid(transforms).all():
        return Record(pair, failure="returned a motion that is not rigid")
    return Record(pair, transforms.tolist(), float(answer.seconds))
