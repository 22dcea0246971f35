"""A second look at a pair whose first answer is in doubt.

Most pairs are answered right from where they lie, and most of the others show it in the confidence.
From a few other starts, tried on thinned clouds, the network then often finds what it missed: time
is spent where it is needed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from cfr_jax.alignment import choosing, confidence, doubts, refining, search, solving, starts
from cfr_jax.alignment.case import Case
from cfr_jax.alignment.choosing import Step
from cfr_jax.alignment.planning import Plan
from cfr_jax.networks.probability import calibration_of
from cfr_jax.refine import Refinement


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

    The answer so far always takes part (`choosing.clearly_better`). It stands unasked where it is
    trusted and the plan wants a search only `if_doubted`.
    """
    plain = choosing.finished(case, finish)
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
        other = choosing.keep_start(other, refine=refine, finish=finish)
    best = other if choosing.clearly_better(other, plain) else plain
    return dataclasses.replace(best, searched=searched.searched)


def _confidence(case: Case) -> float | None:
    found, fitted = case.solved(), calibration_of(case.params)
    return doubts.probability(fitted, confidence.named(found.clues), float(found.quality.fitness))
