"""Tries further starts if an answer is in doubt, and compares the network's answer with its start.

For most pairs, the answer from where the clouds lie is right. Most wrong answers have a low
confidence. For those, the network often finds the right motion from one of a few other starts,
which are tried on thinned clouds. So extra time is spent only on the pairs that need it.

The network may also move away from a start that was right. So a start that the caller gave or that
a search found is refined without the network, too, and the better of the two motions is the answer.
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

# For 25 of 153 pairs (val.h5, and rooms from the frames used to make choices), only one of the two
# answers was right: the one with a search, or the one without. This factor chose the right answer
# 24 times, and so does any other up to 0.98.
_CLEARLY = 0.95


def look_again(case: Case, *, refine: Refinement | None) -> Case:
    """Solves a doubtful case from another start. Returns whichever case is more likely right.

    The starts are those of `starts.around`, and the clouds as they lie in their frames. Nothing is
    tried if the answer is trusted, if the caller or a search chose the start, or if the weights
    have no calibration, because then nothing says which answer is more likely right.
    """
    first = _confidence(case)
    if case.plan.start_given or first is None or doubts.trusted(first):
        return case
    beside = starts.as_they_lie(case.plan.frames)
    case = search.tried(case, starts.around(), beside=beside, nearby=True)
    again = solving.solve_case(search.started(case), refine=refine)
    second = _confidence(again)
    return again if second is not None and second > first else case


def look_everywhere(
    case: Case, *, plan: Plan, refine: Refinement | None, finish: Sequence[Step]
) -> Case:
    """Searches from all `plan.starts`. Returns the case that the search found, if it is clearly
    better, and otherwise the case without a search. Either one is finished.

    The answer so far is always compared (`clearly_better`). There is no search if this answer is
    trusted and the plan wants a search only `if_doubted`.
    """
    plain = finished(case, finish)
    sure = _confidence(plain)
    if plan.if_doubted and doubts.trusted(sure):
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
    """The finished case with the best of three motions: the network's, or one from the start.

    The candidates are the network's answer, the start as it is, and the start after `refine` (if
    JAX can trace it). Each goes through the steps of `finish`, and the one with the smallest
    `measuring.misfit` is the answer. If it is not the network's, its quality and clues are measured
    again.
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
    """The motion that a refinement which JAX can trace finds from where the source lies."""
    first, second = (solving.surface(cloud.prepared()) for cloud in (source, target))
    return jnp.asarray(refine(first, second, jnp.eye(4)).transform)


def clearly_better(other: Case, case: Case) -> bool:
    """Whether the misfit of `other`, which was solved from another start, is so much smaller than
    that of `case` that the difference cannot be chance."""
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
