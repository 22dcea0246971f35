"""A second look at a pair whose first answer is in doubt.

Most pairs are answered right from where they lie, and most of the others show it in the confidence.
From a few other starts, tried on thinned clouds, the network then often finds what it missed: time
is spent where it is needed.
"""

from __future__ import annotations

import dataclasses

from cfr_jax.alignment import confidence, doubts, search, solving, starts
from cfr_jax.alignment.case import Case, Found
from cfr_jax.refine import Refinement


def look_again(case: Case, *, refine: Refinement | None) -> Case:
    """The case as it is, or solved from another start where that is more likely to be right.

    Nothing is tried where the answer is trusted, or where somebody said where the source starts.
    """
    first = _confidence(case.solved())
    if case.plan.start_given or first >= doubts.TRUSTED:
        return case
    searched = search.tried(case, starts.around(), nearby=True)
    case = dataclasses.replace(case, searched=searched)
    other = dataclasses.replace(case, plan=case.plan.started_at(searched.unit_motions[0]))
    again = solving.solve_case(other, refine=refine)
    return again if _confidence(again.solved()) > first else case


def _confidence(found: Found) -> float:
    return doubts.probability(confidence.named(found.clues), float(found.quality.fitness))
