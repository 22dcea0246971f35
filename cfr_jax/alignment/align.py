"""`align` finds the motion between two clouds of one thing, of any size, units and offset."""

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
from cfr_jax.alignment.second_look import keep_start, look_again, look_everywhere
from cfr_jax.alignment.solving import on_accelerator, solve_case
from cfr_jax.networks.cfr.network import check_params
from cfr_jax.networks.probability import calibration_of
from cfr_jax.networks.record import Params
from cfr_jax.refine import Refinement, find
from cfr_jax.weights.files import load_params


def align(
    source: Any,
    target: Any,
    *,
    params: Params | None = None,
    refine: bool | str = True,
    initial: Float[np.ndarray, "4 4"]
    | Float[np.ndarray, "k 4 4"]
    | Literal["global", "auto"]
    | None = None,
    max_points: int | None = None,
    all_points: bool = True,
    second_look: bool = True,
    seed: int = 0,
) -> Alignment:
    """Finds the rigid motion that lays `source` on `target`.

    A cloud is an (n, 3) array, an (n, 6) array with normals, a path, or anything else that
    `io.as_point_cloud` accepts. Both clouds are centered and scaled in float64, and thinned to
    `max_points` each (default 1,024; `seed` determines which points are kept). Normals are
    estimated if a cloud has none. The network with `params` (default: the shipped weights) then
    registers the clouds in two cascades.

    `refine` says how this answer is refined: with our own generalized ICP (True), with another
    refinement from the table of `cfr_jax.refine` (such as "small_gicp"), or not at all (False). If
    a cloud was thinned, a last refinement uses all points of both clouds (`refine.all_points`), and
    `fitness`, `inlier_rmse`, `overlap` and `information` are measured on all points. With
    `all_points=False`, everything is computed on the thinned clouds. A refinement never makes the
    score worse.

    `initial` says where to start. Without it, the centroids are laid on each other. The network is
    trained for rotations of up to 45 degrees about each axis from the start.

    - A (4, 4) motion moves the source close to the target first. This start is also refined without
      the network. That answer is kept if the clouds then fit better than after the network, as
      measured on all points in both directions (`measuring.misfit`).
    - Several motions (k, 4, 4) are all tried on thinned clouds. The one from which the clouds fit
      best is used as the start.
    - "global" also tries starts that cover all rotations (`search`), and takes the motion that it
      finds if this is clearly better than the answer without them. This takes several times as
      long, and also reports other motions that fit about as well.
    - "auto" does the same as "global", but only if the confidence in the answer without these
      starts is below one half.

    If there is no `initial` and the refined answer is not trusted, it gets a `second_look`: the
    clouds as they lie, and some starts around the first one, are tried in the same way. Whichever
    answer is more likely right is kept. Weights without a calibration cannot tell which one that
    is, so they get no second look.

    Of the `Alignment` that it returns, read `transform`, `trusted` and `warnings` first. The same
    call gives the same answer, bit by bit, on the same machine.

    Raises ValueError for clouds without extent or with fewer than 3 points, for wrong shapes, for
    values that are not finite, and for an `initial` that is not a rigid motion or that leaves the
    clouds far apart. Raises `io.CloudFileError` for bad files, and ModuleNotFoundError if the
    library of `refine` is missing.
    """
    began = time.perf_counter()
    refinements = chosen_refinements(refine, all_points=all_points)
    plan = planned(
        source,
        target,
        initial=initial,
        max_points=max_points,
        seed=seed,
        whole=any(each.every_point for each in refinements),
        search=not on_accelerator(),
    )
    case = Case(checked_params(params), plan)
    for step in steps(plan, refinements, second_look=second_look):
        case = step(case)
    case.seconds["total"] = time.perf_counter() - began
    return answer(case)


def chosen_refinements(refine: bool | str, *, all_points: bool = True) -> tuple[Refinement, ...]:
    """The refinements that `align` runs, in order. Raises ModuleNotFoundError if a library that
    one of them needs is missing."""
    first = find(refine)
    if first is None:
        return ()
    if first.every_point and not all_points:
        raise ValueError(
            f"all_points: got False with refine={refine!r}, which needs all points; "
            "wanted True or another refinement"
        )
    last = find("all_points") if all_points and not first.every_point else None
    chosen = tuple(each for each in (first, last) if each is not None)
    for each in chosen:
        each.require()  # before anything is computed
    return chosen


def steps(
    plan: Plan, refinements: tuple[Refinement, ...], *, second_look: bool
) -> Iterator[Callable[[Case], Case]]:
    """The steps from a plan to its answer. Each step takes the case that the previous one
    returned."""
    if plan.starts is not None and plan.start_given:
        yield search
    yield functools.partial(solve_case, refine=_traced(refinements))
    yield from after_network(plan, refinements, second_look=second_look)


def after_network(
    plan: Plan, refinements: tuple[Refinement, ...], *, second_look: bool
) -> Iterator[Callable[[Case], Case]]:
    """The steps from the network's answer for a plan to the final answer."""
    traced, last = _traced(refinements), tuple(on_host(plan, refinements))
    if second_look and traced is not None:
        yield functools.partial(look_again, refine=traced)
    if plan.starts is not None and not plan.start_given:
        yield functools.partial(look_everywhere, plan=plan, refine=traced, finish=last)
    elif plan.start_given and refinements:
        yield functools.partial(keep_start, refine=traced, finish=last)
    else:
        yield from last


def _traced(refinements: tuple[Refinement, ...]) -> Refinement | None:
    """The refinement that is compiled into the network's program, if there is one."""
    return refinements[0] if refinements and refinements[0].traceable else None


def on_host(plan: Plan, refinements: tuple[Refinement, ...]) -> Iterator[Callable[[Case], Case]]:
    """The steps of the refinements that run on the host.

    A refinement on all points that follows another one is skipped if the network has seen all
    points, because the first refinement has already used them all.
    """
    for number, each in enumerate(refinements):
        if each.every_point and (plan.thinned or number == 0):
            yield functools.partial(refine_every_point, refine=each)
        elif not each.every_point and not each.traceable:
            yield functools.partial(refine_used_points, refine=each)


def checked_params(params: Any) -> Params:
    """Returns the parameters after checking them; None stands for the shipped weights. Raises
    ValueError for anything that is not a set of parameters, and for a calibration that uses other
    clues than those of `align`."""
    params = _default_params() if params is None else params
    check_params(params)
    if (fitted := calibration_of(params)) is not None:
        fitted.check("align", confidence.NAMES)
    return dict(params)


@functools.cache
def _default_params() -> Params:
    return load_params()
