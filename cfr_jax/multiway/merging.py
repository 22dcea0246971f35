"""`merge` finds the pose of each of many scans of one thing, and makes one model of them."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Unpack

import numpy as np
from jaxtyping import Float

from cfr_jax.geometry import motions
from cfr_jax.multiway import choosing
from cfr_jax.multiway.answers import Fused, Merged
from cfr_jax.multiway.building import build, refined
from cfr_jax.multiway.choosing import Try
from cfr_jax.multiway.fusing import fuse_models
from cfr_jax.multiway.registering import CLOSURE, NEAR, Memory, Options, RecordStore, Registrar
from cfr_jax.multiway.reporting import answer
from cfr_jax.multiway.scans import LeftOut, Scan, load, names_of, of_other_sizes, twins
from cfr_jax.multiway.searching import closures, searched
from cfr_jax.networks.record import Params
from cfr_jax.runtime.entries import entry
from cfr_jax.runtime.progress import Progress


@entry
def merge(
    clouds: Sequence[Any],
    *,
    params: Params | None = None,
    sequence: bool = False,
    everywhere: bool = False,
    loop_closures: bool = False,
    guesses: Sequence[Float[np.ndarray, "4 4"] | None] | None = None,
    reference: int | None = None,
    voxel: float | None = None,
    fused: bool = True,
    max_points: int | None = None,
    seed: int = 0,
    batch: int | None = None,
    workers: int | None = None,
    kept: RecordStore | None = None,
    progress: bool = False,
) -> Merged:
    """Merges many scans of one thing: finds the pose of each scan, and makes one cloud.

    Each of `clouds` is anything that `align` accepts. `align_many` registers all pairs of them.
    With `sequence`, each scan is registered only with the next two. With `loop_closures`, pairs
    that overlap under the poses found so far are then registered as well. Scans may be turned
    against each other by up to about 45 degrees about each axis. With `everywhere`, scans that
    found no place are also tried from all rotations. `guesses` are approximate poses to start from;
    use None for scans whose pose is unknown.

    Edges that contradict others are found and dropped, a pose graph is solved, and all scans are
    refined together. A scan is placed only if a cycle of registrations confirms its place. If the
    order of the scans is known or there are only two, a single sure registration is enough. All
    other scans are listed in `left_out` with the reason. Groups of scans that nothing connects
    become separate components.

    Poses map each scan into the frame of the scan with index `reference` (default: the first placed
    scan). Each component gets a merged cloud with one point for each cube of size `voxel` (default:
    the spacing of the scans' points), unless `fused` is False.

    `kept` stores the registrations and is looked up first, so a run that was killed continues where
    it stopped if `kept` is a file, such as a `batch.journal.Journal`. `max_points`, `seed`, `batch`
    and `workers` are those of `align_many`. The same call gives the same answer.

    Raises ValueError for options that cannot be used, and if fewer than two scans can be merged.
    """
    began = time.perf_counter()
    clouds = list(clouds)
    _check(clouds, guesses, reference, voxel)
    options: Options = {
        "params": params,
        "max_points": max_points,
        "seed": seed,
        "batch": batch,
        "workers": workers,
    }
    start = _start(clouds, sequence, guesses, Memory() if kept is None else kept, progress, options)
    usable, registrar, tries = start.scans, start.registrar, start.tries
    seconds = {"read": time.perf_counter() - began}

    started = time.perf_counter()
    records = registrar.records(tries, NEAR)
    alone = sequence or len(usable) == 2
    built = build(usable, tries, records, alone=alone)
    if everywhere and built.placement.component.any():
        tries, records, built = searched(usable, registrar, tries, records, alone)
    if loop_closures and (more := closures(usable, tries, built)):
        records = records + registrar.records(more, CLOSURE)
        built = build(usable, tries + more, records, alone=alone)
    seconds["register"] = time.perf_counter() - started

    started = time.perf_counter()
    built, covariances = refined(usable, built, reference)
    seconds["refine"] = time.perf_counter() - started

    started = time.perf_counter()
    found = answer(start.names, usable, built, covariances, start.left_out, start.copies, reference)
    models: tuple[Fused, ...] = ()
    if fused:
        size = voxel or float(np.median([scan.full_spacing for scan in usable]))
        models = fuse_models(clouds, found, start.copies, size, progress)
    seconds["fuse"] = time.perf_counter() - started
    seconds["total"] = time.perf_counter() - began
    return dataclasses.replace(found, clouds=models, seconds=seconds)


def register_share(
    clouds: Sequence[Any],
    rows: slice,
    *,
    kept: RecordStore,
    sequence: bool = False,
    guesses: Sequence[Float[np.ndarray, "4 4"] | None] | None = None,
    progress: bool = False,
    **options: Unpack[Options],
) -> int:
    """Registers only a part of the pairs that `merge` registers first, and returns their number.

    `rows` selects this part of the pairs, as `batch.sharding.Shard.rows` does. The records are
    stored in `kept`, so `merge` does not register these pairs again. `options` are those of
    `merge`, with the same defaults.
    """
    clouds = list(clouds)
    _check(clouds, guesses, None, None)
    start = _start(clouds, sequence, guesses, kept, progress, options)
    return len(start.registrar.records(start.tries[rows], NEAR))


@dataclass(frozen=True, eq=False)
class _Start:
    """Everything that is known before the first registration."""

    names: tuple[str, ...]
    scans: list[Scan]
    """The scans that can be registered."""
    left_out: list[LeftOut]
    copies: dict[int, int]
    """The index of each repeated scan, with the index of the first scan that has its points."""
    registrar: Registrar
    tries: list[Try]


def _start(
    clouds: list[Any],
    sequence: bool,
    guesses: Sequence[Float[np.ndarray, "4 4"] | None] | None,
    kept: RecordStore,
    progress: bool,
    options: Options,
) -> _Start:
    names = names_of(clouds)
    scans, left_out = _read(clouds, names, options.get("seed", 0), progress)
    copies = twins(scans)
    foreign = of_other_sizes(scans)
    left_out += foreign
    apart = {each.index for each in foreign} | copies.keys()
    usable = [scan for scan in scans if scan.index not in apart]
    if len(usable) < 2:
        reasons = "; ".join(f"{each.name}: {each.reason}" for each in left_out[:2])
        raise ValueError(
            "clouds: wanted at least two scans that can be merged" + f" ({reasons})" * bool(reasons)
        )
    registrar = Registrar({s.index: s for s in usable}, kept, options, progress=progress)
    tries = choosing.in_sequence(usable) if sequence else choosing.all_pairs(usable)
    if guesses is not None:
        known = {index: pose for index, pose in enumerate(guesses) if pose is not None}
        tries = choosing.from_guesses(tries, known)
    return _Start(names, usable, left_out, copies, registrar, tries)


def _check(
    clouds: Sequence[Any],
    guesses: Sequence[Any] | None,
    reference: int | None,
    voxel: float | None,
) -> None:
    if len(clouds) < 2:
        raise ValueError(f"clouds: got {len(clouds)}, wanted at least two scans")
    if guesses is not None:
        if len(guesses) != len(clouds):
            raise ValueError(
                f"guesses: got {len(guesses)} for {len(clouds)} clouds, wanted one (or None) each"
            )
        for index, guess in enumerate(guesses):
            if guess is not None:
                motions.check_rigid(f"guesses[{index}]", guess)
    if reference is not None and not 0 <= reference < len(clouds):
        raise ValueError(f"reference: got {reference}, wanted 0 to {len(clouds) - 1}")
    if voxel is not None and not voxel > 0:
        raise ValueError(f"voxel: got {voxel}, wanted a positive length")


def _read(
    clouds: Sequence[Any], names: Sequence[str], seed: int, progress: bool
) -> tuple[list[Scan], list[LeftOut]]:
    scans: list[Scan] = []
    left_out: list[LeftOut] = []
    loaded = load(clouds, names, seed=seed)
    for each in Progress(
        loaded, total=len(clouds), desc="reading", unit=" scans", disable=not progress
    ):
        if isinstance(each, Scan):
            scans.append(each)
        else:
            left_out.append(each)
    return scans, left_out
