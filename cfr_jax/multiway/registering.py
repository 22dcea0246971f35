"""Registers pairs of scans with `align_many`, each only once: pairs in the journal are not redone.

A target that many scans share is encoded once, because `choosing` orders the pairs by target.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, TypedDict, runtime_checkable

from cfr_jax.alignment.align import align
from cfr_jax.batch.jobs import Job
from cfr_jax.batch.records import as_record
from cfr_jax.batch.stream import Outcome, align_many
from cfr_jax.multiway.choosing import Try
from cfr_jax.multiway.scans import Scan
from cfr_jax.networks.record import Params
from cfr_jax.runtime.progress import Progress

Record = dict[str, Any]
NEAR, CLOSURE, ANYWHERE = range(3)
"""The kind of start: where the scans lie, where the poses put them, or all rotations. Two scans may
have one record of each kind."""


class Options(TypedDict, total=False):
    """Options of the registration: arguments of `align_many`, with its defaults."""

    params: Params | None
    max_points: int | None
    seed: int
    batch: int | None
    workers: int | None


@runtime_checkable
class RecordStore(Protocol):
    """A store of records, such as `batch.journal.Journal`."""

    def __contains__(self, key: tuple[str, str, int]) -> bool: ...

    def __getitem__(self, key: tuple[str, str, int]) -> Record: ...

    def write(self, record: Record) -> None:
        """Stores a record."""


class Memory(dict[tuple[str, str, int], Record]):
    """A store of records in memory, which lasts as long as the program runs."""

    def write(self, record: Record) -> None:
        """Stores a record."""
        self[record["source"], record["target"], record["repeat"]] = record


class Registrar:
    """Registers pairs of scans, and skips those that are already done."""

    def __init__(
        self, scans: Mapping[int, Scan], kept: RecordStore, options: Options, *, progress: bool
    ):
        self._scans, self._kept = scans, kept
        self._options, self._progress = options, progress

    def records(self, tries: Sequence[Try], kind: int) -> list[Record]:
        """Returns the record of each pair, in order. Registers the pairs that have none yet."""
        jobs = [self._job(pair, kind) for pair in tries]
        left = [row for row, job in enumerate(jobs) if self._found(job, tries[row]) is None]
        if left:
            with Progress(
                total=len(jobs),
                initial=len(jobs) - len(left),
                desc="registering",
                unit=" pairs",
                disable=not self._progress,
            ) as bar:
                for outcome in self._outcomes([tries[row] for row in left], kind):
                    row = left[outcome.index]
                    record = as_record(jobs[row], outcome)
                    self._kept.write(record | {"digests": self._digests(tries[row])})
                    bar.update()
        return [self._kept[job.key] for job in jobs]

    def _outcomes(self, tries: list[Try], kind: int) -> Any:
        if kind != ANYWHERE:
            return align_many((self._pair(each) for each in tries), ordered=False, **self._options)
        return (self._searched(row, each) for row, each in enumerate(tries))

    def _searched(self, row: int, pair: Try) -> Outcome:
        """The answer of a search over all rotations, which works on one pair at a time."""
        options: dict[str, Any] = {
            name: value for name, value in self._options.items() if name not in _OF_BATCHES
        }
        try:
            found = align(*self._pair(pair)[:2], initial="global", **options)
        except ValueError as error:
            return Outcome(row, None, str(error))
        return Outcome(row, found, None)

    def _pair(self, pair: Try) -> tuple[Any, ...]:
        clouds = self._scans[pair.source].cloud, self._scans[pair.target].cloud
        return clouds if pair.initial is None else (*clouds, pair.initial)

    def _job(self, pair: Try, kind: int) -> Job:
        names = self._scans[pair.source].name, self._scans[pair.target].name
        return Job(*names, kind, lambda: self._pair(pair)[:2])

    def _digests(self, pair: Try) -> list[str]:
        return [self._scans[pair.source].digest, self._scans[pair.target].digest]

    def _found(self, job: Job, pair: Try) -> Record | None:
        """The record of a pair, or None if it is not done or one of its files has changed since."""
        record = self._kept[job.key] if job.key in self._kept else None
        return record if record and record.get("digests") == self._digests(pair) else None


_OF_BATCHES = ("batch", "workers")
