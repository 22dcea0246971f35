"""Solves plans of one size together: encodes each target once and maps over the pairs."""

from __future__ import annotations

import functools
import hashlib
import time
from collections.abc import Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from cfr_jax.alignment import solving
from cfr_jax.alignment.align import after_network
from cfr_jax.alignment.answers import Alignment, answer
from cfr_jax.alignment.case import Case, Found
from cfr_jax.alignment.planning import SETTINGS, Plan
from cfr_jax.batch.memo import Memo
from cfr_jax.geometry.units import UnitCloud
from cfr_jax.networks.cfr.iterations import Encoded
from cfr_jax.networks.cfr.registration import encode
from cfr_jax.networks.record import Params
from cfr_jax.refine import Refinement
from cfr_jax.runtime import programs

Signature: TypeAlias = tuple[tuple[tuple[int, ...], int, bool], ...]
"""Of source and target: the shapes of points and neighbors, and whether there are no normals."""

_KEPT = 32  # encoded targets, about 2 MB each


class Device:
    """Runs programs on the accelerator, and remembers the targets that it encoded last."""

    def __init__(
        self, params: Params, refinements: tuple[Refinement, ...], second_look: bool, size: int
    ):
        self._params, self._refinements = params, refinements
        self.size: int = size
        self._refine = refinements[0] if refinements else None
        self._second_look = second_look
        self._encoded = Memo(_KEPT)

    def solve(self, plans: Sequence[Plan]) -> list[Alignment]:
        """The answers to at most `size` plans with the same `signature`.

        A short batch repeats its last plan, so that it needs no program of its own.
        """
        began = time.perf_counter()
        filled = [*plans, *[plans[-1]] * (self.size - len(plans))]
        targets, waited = zip(*(self._encode(plan.target) for plan in filled), strict=True)
        arguments = (
            self._params,
            list(solving.on_device(*(plan.source for plan in filled))),
            targets,
        )
        started = time.perf_counter()
        program = programs.compiled(solve_many, *arguments, refine=self._refine)
        compiled = time.perf_counter()
        found = jax.device_get(program(*arguments))
        done = time.perf_counter()
        compiling = sum(waited) + compiled - started
        seconds = {
            "compile": compiling / len(plans),
            "run": (done - began - compiling) / len(plans),
            "total": (done - began) / len(plans),
        }
        return [
            self._answer(plan, jax.tree.map(lambda leaf, row=row: leaf[row], found), seconds)
            for row, plan in enumerate(plans)
        ]

    def _answer(self, plan: Plan, found: Found, seconds: dict[str, float]) -> Alignment:
        """The answer, after what takes one pair at a time: a second look if it is in doubt, a
        start that was given, and the refinements on the host."""
        case = Case(self._params, plan, found, seconds=dict(seconds))
        began = time.perf_counter()
        for step in after_network(plan, self._refinements, second_look=self._second_look):
            case = step(case)
        case.seconds["total"] += time.perf_counter() - began
        return answer(case)

    def _encode(self, target: UnitCloud) -> tuple[Encoded, float]:
        """The features of a target, and the seconds it took to compile their program."""
        compiling = 0.0

        def make() -> Encoded:
            nonlocal compiling
            arguments = (self._params, *solving.on_device(target))
            started = time.perf_counter()
            program = programs.compiled(encode_target, *arguments)
            compiling = time.perf_counter() - started
            return program(*arguments)

        return self._encoded.get(_digest(target), make), compiling


def signature(plan: Plan) -> Signature:
    """A key that is equal for plans that one compiled program can solve."""
    return tuple(
        (cloud.points.shape, cloud.neighbor_count, cloud.normals is None)
        for cloud in (plan.source, plan.target)
    )


@jax.jit
def encode_target(params: Params, target: solving.DeviceCloud) -> Encoded:
    """The target's side of `solving.solve`, for a cloud that `solving.on_device` returned."""
    return encode(params, target.prepared(), settings=SETTINGS)


@functools.partial(jax.jit, static_argnames=("refine",))
def solve_many(
    params: Params,
    sources: Sequence[solving.DeviceCloud],
    targets: Sequence[Encoded],
    *,
    refine: Refinement | None,
) -> Found:
    """`solving.solve` for pairs of one size, all at once; each leaf has the pairs as first axis."""

    def solve(source: solving.DeviceCloud, target: Encoded) -> Found:
        return solving.solve(params, source.prepared(), target, refine=refine)

    def stacked(clouds: Any) -> Any:
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *clouds)

    if len(sources) == 1:  # without a batch axis: one of length one makes a CPU slower
        return stacked([solve(sources[0], targets[0])])
    return jax.vmap(solve)(stacked(sources), stacked(targets))


def _digest(cloud: UnitCloud) -> bytes:
    held = hashlib.sha256(repr(cloud.points.shape).encode())
    for array in (cloud.points, cloud.normals, cloud.neighbors, cloud.mask):
        held.update(b"-" if array is None else np.ascontiguousarray(array).tobytes())
    return held.digest()
