"""A second look at a pair whose first answer is in doubt.

Most pairs are answered right from where they lie, and most of the others show it in the confidence.
From a few other starts, tried on thinned clouds, the network then often finds what it missed: time
is spent where it is needed.
"""

from __future__ import annotations

import dataclasses

from cfr_jax.alignment import confidence, doubts, solving
from cfr_jax.alignment.planning import Plan
from cfr_jax.alignment.search import Search, around, search


def look_again(
    params: dict, plan: Plan, found: solving.Found, *, seconds: dict[str, float]
) -> tuple[Plan, solving.Found, Search | None]:
    """What was found of a plan, or from another start what is more likely to be right.

    Nothing is tried where the answer is trusted, or where somebody said where the source starts.
    Adds its time to `seconds`, as `solving.timed` does.
    """
    first = _confidence(found)
    if plan.start_given or first >= doubts.TRUSTED:
        return plan, found, None
    searched = dataclasses.replace(search(params, plan, around(), seconds=seconds), nearby=True)
    other = plan.started_at(searched.unit_motions[0])
    clouds = solving.on_device(other.source), solving.on_device(other.target)
    again = solving.timed(seconds, solving.solve_pair, params, *clouds, refine=True)
    if _confidence(again) > first:
        return other, again, searched
    return plan, found, searched


def _confidence(found):
    return doubts.probability(confidence.named(found.clues), float(found.quality.fitness))
