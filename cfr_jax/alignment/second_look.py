"""Other starts than the one where the source lies: where an answer is in doubt, and a start given.

Most pairs are answered right from where they lie, and most of the others show it in the confidence.
From a few other starts, tried on thinned clouds, the network then often finds what it missed: time
is spent where it is needed.

The network also moves on from a start that was right. So a start that somebody gave, or that a
search found, is refined beside what the network found from it, and the better one is the answer.
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

from cfr_jax.alignment import confidence, doubts, refining, search, solving, starts
from cfr_jax.alignment.case import Case
from cfr_jax.alignment.planning import Plan
from cfr_jax.networks.probability import calibration_of
from cfr_jax.refine import Refinement

Step: TypeAlias = Callable[[Case], Case]

# Of 153 pairs (val.h5, and rooms of the frames for choices), 25 were right by only one of the plain
# answer and that of a search; this took the right one 24 times. So does anything up to 0.98.
_CLEARLY = 0.95


def look_again(case: Case, *, refine: Refinement | None) -> Case:
    """The case as it is, or solved from another start where that is more likely to be right.

    Starts are `starts.around` the first and the clouds as they lie in their frames. Nothing is
    tried where the answer is trusted, where somebody said where the source starts, or where weights
    without calibration leave open which answer is more likely right.
    """
    first = _confidence(case)
    if case.plan.start_given or first is None or first >= doubts.TRUSTED:
        return case
    beside = starts.as_they_lie(case.plan.frames)
    case = search.tried(case, starts.around(), beside=beside, nearby=True)
    again = solving.solve_case(search.started(case), refine=refine)
    second = _confidence(again)
    return again if second is not None and second > first else case


def look_everywhere(
    case: Case, *, plan: Plan, refine: Refinement | None, finish: Sequence[Step]
) -> Case:
    """The case finished, or solved from one of all `plan.starts` where that is clearly better.

    The answer so far always takes part (`clearly_better`). It stands unasked where it is
    trusted and the plan wants a search only `if_doubted`.
    """
    plain = finished(case, finish)
    sure = _confidence(plain)
    if plan.if_doubted and sure is not None and sure >= doubts.TRUSTED:
        return plain
    plain = refining.placed(plain)
    assert plan.starts is not None
    mine = plan.frames.to_unit(plain.plan.frames.to_caller(np.asarray(plain.solved().transform)))
    beside = np.concatenate([mine[None], starts.as_they_lie(plan.frames)])
    searched = search.tried(dataclasses.replace(plain, plan=plan), plan.starts, beside=beside)
    other = solving.solve_case(search.started(searched), refine=refine)
    if finish or refine is not None:
        other = keep_start(other, refine=refine, finish=finish)
    best = other if clearly_better(other, plain) else plain
    return dataclasses.replace(best, searched=searched.searched)


def keep_start(case: Case, *, refine: Refinement | None, finish: Sequence[Step]) -> Case:
    """The case finished, from what the network found or from where the source started.

    Candidates are the network's answer, the start after `refine` (if JAX can trace it), and the
    start as it is. Each goes through the steps of `finish`; the one with the smallest
    `measuring.misfit` is the answer. If that is not the network's, what is told of it is measured
    anew.
    """
    placed_at = [np.eye(4, dtype=np.float32)]
    sides = solving.on_device(case.plan.source, case.plan.target)
    if refine is not None:
        refined = solving.timed(case.seconds, refined_start, *sides, refine=refine)
        placed_at.append(jax.device_get(refined))
    case = refining.placed(case)
    begun = (case, *(_with(case, start) for start in placed_at))
    candidates = [finished(each, finish) for each in begun]
    best = min(candidates, key=refining.misfit)
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
    return refining.misfit(other) < _CLEARLY * refining.misfit(case)


def finished(case: Case, steps: Sequence[Step]) -> Case:
    """The case after these steps."""
    return functools.reduce(lambda case, step: step(case), steps, case)


def _with(case: Case, transform: Float[np.ndarray, "4 4"]) -> Case:
    found = dataclasses.replace(case.solved(), transform=transform, improved=np.array(True))
    return dataclasses.replace(case, found=found)


def _confidence(case: Case) -> float | None:
    found, fitted = case.solved(), calibration_of(case.params)
    return doubts.probability(fitted, confidence.named(found.clues), float(found.quality.fitness))
