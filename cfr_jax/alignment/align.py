"""`align`: two clouds of one thing, any size, units and offset, and the motion between them."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from cfr_jax.alignment import confidence
from cfr_jax.alignment.answers import Alignment, answer
from cfr_jax.alignment.case import Case
from cfr_jax.alignment.planning import Plan, planned
from cfr_jax.alignment.refining import refine_every_point, refine_used_points
from cfr_jax.alignment.search import search
from cfr_jax.alignment.second_look import look_again
from cfr_jax.alignment.solving import solve_case
from cfr_jax.networks.cfr.network import check_params
from cfr_jax.networks.probability import calibration_of
from cfr_jax.refine import Refinement, find
from cfr_jax.weights.files import load_params


def align(
    source: Any,
    target: Any,
    *,
    params: dict | None = None,
    refine: bool | str = True,
    initial: Float[np.ndarray, "4 4"]
    | Float[np.ndarray, "k 4 4"]
    | Literal["global"]
    | None = None,
    max_points: int | None = None,
    all_points: bool = False,
    second_look: bool = True,
    seed: int = 0,
) -> Alignment:
    """Finds the rigid motion that lays `source` on `target`.

    Clouds are (n, 3) arrays, (n, 6) with normals, paths, or what else `io.as_point_cloud` takes.
    They are centered and scaled in float64, thinned to `max_points` each (default 1,024; `seed`
    says which), given normals where they have none, registered by the network with `params`
    (default: the weights that ship) in two cascades, and refined by our generalized ICP, by another
    way that `cfr_jax.refine` knows by name (`refine="small_gicp"`), or not at all (False). Refining
    never makes the score worse. With `all_points` it is refined further on every point there is
    (`refine.pyramid`); `fitness` and `inlier_rmse` are then of all points, too.

    `initial` (4, 4) moves the source close to the target first; without it the centroids are laid
    on each other. The network is trained for up to 45 degrees about each axis from there. Several
    (k, 4, 4) are all tried on thinned clouds, and the one from which the clouds come to lie best on
    each other is taken; "global" tries a cover of all rotations (`search`), which takes some
    times as long, and tells of other motions that fit about as well. Without `initial`, a refined
    answer that is not to be trusted gets a `second_look`: some starts around the first are tried in
    the same way, and what is more likely right is kept (weights without calibration cannot tell,
    and take none). The same call gives the same answer, to the bit, on the same machine.

    Raises ValueError for clouds without extent or with fewer than 3 points, wrong shapes, values
    that are not finite, and an `initial` that is no rigid motion or leaves the clouds far apart;
    `io.CloudFileError` for files; ModuleNotFoundError for small_gicp without that library.
    """
    began = time.perf_counter()
    refinements = chosen_refinements(refine, all_points=all_points)
    whole = any(each.every_point for each in refinements)
    plan = planned(source, target, initial=initial, max_points=max_points, seed=seed, whole=whole)
    case = Case(checked_params(params), plan)
    for step in steps(plan, refinements, second_look=second_look):
        case = step(case)
    case.seconds["total"] = time.perf_counter() - began
    return answer(case)


def chosen_refinements(refine: bool | str, *, all_points: bool = False) -> tuple[Refinement, ...]:
    """The refinements that `align` takes one after the other, their libraries there."""
    first = find(refine)
    if first is None:
        if all_points:
            raise ValueError(
                "all_points: got True with refine=False, wanted a refinement to go on from"
            )
        return ()
    last = find("pyramid") if all_points and not first.every_point else None
    chosen = tuple(each for each in (first, last) if each is not None)
    for each in chosen:
        each.require()  # before anything is computed
    return chosen


def steps(
    plan: Plan, refinements: tuple[Refinement, ...], *, second_look: bool
) -> Iterator[Callable[[Case], Case]]:
    """The way of a plan to its answer: each step takes the case as the one before it left it."""
    traced = refinements[0] if refinements and refinements[0].traceable else None
    if plan.starts is not None:
        yield search
    yield functools.partial(solve_case, refine=traced)
    if second_look and traced is not None and plan.starts is None:
        yield functools.partial(look_again, refine=traced)
    for each in refinements[traced is not None :]:
        yield functools.partial(
            refine_every_point if each.every_point else refine_used_points, refine=each
        )


def checked_params(params: Any) -> dict:
    """The weights that ship for None; raises ValueError for what are no parameters, and for a
    calibration made of other clues than `align` finds."""
    params = _default_params() if params is None else params
    check_params(params)
    if (fitted := calibration_of(params)) is not None:
        fitted.check("align", confidence.NAMES)
    return dict(params)


@functools.cache
def _default_params() -> dict:
    return load_params()
