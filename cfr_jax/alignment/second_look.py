"""A second look at a pair whose first answer is in doubt.

Most pairs are answered right from where they lie, and most of the others show it in the confidence.
From a few other starts, tried on thinned clouds, the network then often finds what it missed: time
is spent where it is needed.
"""

from __future__ import annotations

import dataclasses

from cfr_jax.alignment import confidence, doubts, search, solving, starts
from cfr_jax.alignment.case import Case
from cfr_jax.networks.probability import calibration_of
from cfr_jax.refine import Refinement


def look_again(case: Case, *, refine: Refinement | None) -> Case:
    """The case as it is, or solved from another start where that is more likely to be right.

    Nothing is tried where the answer is trusted, where somebody said where the source starts, or
    where weights without calibration leave open which answer is more likely right.
    """
    first = _confidence(case)
    if case.plan.start_given or first is None or first >= doubts.TRUSTED:
        return case
    searched = search.tried(case, starts.around(), nearby=True)
    case = dataclasses.replace(case, searched=searched)
    other = dataclasses.replace(case, plan=case.plan.started_at(searched.unit_motions[0]))
    again = solving.solve_case(other, refine=refine)
    second = _confidence(again)
    return again if second is not None and second > first else case


def _confidence(case: Case) -> float | None:
    found, fitted = case.solved(), calibration_of(case.params)
    return doubts.probability(fitted, confidence.named(found.clues), float(found.quality.fitness))
