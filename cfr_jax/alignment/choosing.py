"""Which of several motions of the same clouds is the best, told by all points of both.

The network moves on from wherever the source starts, also from a start that was right. So a start
that somebody gave, or that a search found, is refined beside what the network found from it, and
the better of them is the answer.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cfr_jax.alignment import refining, solving
from cfr_jax.alignment.case import Case
from cfr_jax.geometry import motions
from cfr_jax.refine import Refinement, all_points
from cfr_jax.refine.surfaces import HostSurface

Step: TypeAlias = Callable[[Case], Case]

# Of 153 pairs (val.h5 and rooms) on which the plain answer and that of a search differed, this took
# the right one of the two in all but one; anything from 0.95 to 0.98 does.
_CLEARLY = 0.95
_SPACINGS = 2.0  # points of one surface are about half the spacing away from each other


def keep_start(case: Case, *, refine: Refinement | None, finish: Sequence[Step]) -> Case:
    """The case finished, from what the network found or from where the source started.

    Candidates are the network's answer, the start after `refine` (if JAX can trace it), and the
    start as it is. Each goes through the steps of `finish`; the one with the smallest `misfit` is
    the answer, and what is told of it is measured anew if it is not the network's.
    """
    starts = [np.eye(4, dtype=np.float32)]
    sides = solving.on_device(case.plan.source, case.plan.target)
    if refine is not None:
        refined = solving.timed(case.seconds, refined_start, *sides, refine=refine)
        starts.append(jax.device_get(refined))
    case = refining.placed(case)
    candidates = [
        finished(moved, finish) for moved in (case, *(_with(case, start) for start in starts))
    ]
    best = min(candidates, key=misfit_of)
    if best is candidates[0]:
        return best
    found = _with(best, np.asarray(best.solved().transform, np.float32)).solved()
    judged = jax.device_get(solving.timed(case.seconds, solving.judged, *sides, found))
    told = dataclasses.replace(judged, transform=best.solved().transform)
    return refining.measured(dataclasses.replace(best, found=told))


@functools.partial(jax.jit, static_argnames=("refine",))
def refined_start(
    source: solving.DeviceCloud, target: solving.DeviceCloud, *, refine: Refinement
) -> Float[Array, "4 4"]:
    """Where a refinement that JAX can trace ends from where the source lies."""
    first, second = (solving.surface(cloud.prepared()) for cloud in (source, target))
    return jnp.asarray(refine(first, second, jnp.eye(4)).transform)


def clearly_better(other: Case, case: Case) -> bool:
    """Whether the answer of `other`, from another start, has a misfit so much smaller than that of
    `case` that this cannot be chance."""
    return misfit_of(other) < _CLEARLY * misfit_of(case)


def _with(case: Case, transform: Float[np.ndarray, "4 4"]) -> Case:
    found = dataclasses.replace(case.solved(), transform=transform, improved=np.array(True))
    return dataclasses.replace(case, found=found)


def finished(case: Case, steps: Sequence[Step]) -> Case:
    """The case after these steps."""
    return functools.reduce(lambda case, step: step(case), steps, case)


def misfit_of(case: Case, transform: Float[np.ndarray, "4 4"] | None = None) -> float:
    """`misfit` of the answer of a `placed` case, or of another motion of its unit clouds."""
    if transform is None:
        transform = np.asarray(case.solved().transform)
    return misfit(*refining.surfaces(case), refining.to_placed(case, transform))


def misfit(source: HostSurface, target: HostSurface, transform: Float[np.ndarray, "4 4"]) -> float:
    """How badly two clouds lie on each other under `transform` (source onto target), in [0, 1].

    The mean of two losses: of the source's points to the target and of the target's points to the
    source, each `all_points.score`, cut at twice the wider spacing of the two clouds, and at the
    inlier distance at the most. One way alone, a small part lies well on any dense part of a large
    cloud.
    """
    cut = min(solving.DISTANCE, _SPACINGS * max(source.tree.spacing, target.tree.spacing))
    there = all_points.distances(source, target, transform)
    back = all_points.distances(target, source, motions.inverse(transform))
    return (all_points.score(there, cut) + all_points.score(back, cut)) / 2
