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

    Clouds are (n, 3) arrays, (n, 6) with normals, paths, or anything else that `io.as_point_cloud`
    takes. They are centered and scaled in float64, thinned to `max_points` each (default 1,024;
    `seed` says which), given normals if they have none, and registered by the network with `params`
    (default: the weights that ship) in two cascades. Then the answer is refined: by our generalized
    ICP, by another refinement in the table of `cfr_jax.refine` (`refine="small_gicp"`), or not at
    all (False). If a cloud was thinned, a last refinement uses all points of both
    (`refine.all_points`), and `fitness`, `inlier_rmse`, `overlap` and `information` are those of
    all points; with `all_points=False` everything stays with the thinned clouds. A refinement never
    makes the score worse.

    `initial` (4, 4) moves the source close to the target first. Without it, the centroids are laid
    on each other. The network is trained for up to 45 degrees about each axis from there. A given
    start is also refined as it is, and its answer is kept where the clouds then lie better on each
    other than after the network, told by all points both ways (`measuring.misfit`). If there are
    several starts (k, 4, 4), all are tried on thinned clouds, and the one from which the clouds fit
    best is taken. "global" also tries starts that cover all rotations (`search`), and takes what it
    finds where it is clearly better than the answer without them. This takes several times as long,
    and also reports other motions that fit about as well. "auto" does so only where the confidence
    in that answer is below one half. Without `initial`, a refined answer that is not trusted gets a
    `second_look`: some starts around the first, and the clouds as they lie, are tried in the same
    way, and the answer that is more likely right is kept (weights without calibration cannot tell,
    and get no second look). The same call gives the same answer, bit by bit, on the same machine.

    Raises ValueError for clouds without extent or with fewer than 3 points, wrong shapes, values
    that are not finite, and an `initial` that is no rigid motion or leaves the clouds far apart;
    `io.CloudFileError` for files; ModuleNotFoundError if the library of `refine` is missing.
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
    """The refinements that `align` runs, in order, after a check that their libraries are there."""
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
    """The steps from a plan to its answer; each takes the case as the step before left it."""
    if plan.starts is not None and plan.start_given:
        yield search
    yield functools.partial(solve_case, refine=_traced(refinements))
    yield from after_network(plan, refinements, second_look=second_look)


def after_network(
    plan: Plan, refinements: tuple[Refinement, ...], *, second_look: bool
) -> Iterator[Callable[[Case], Case]]:
    """The steps from what the network found for a plan to its answer."""
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
    """What is part of the network's program."""
    return refinements[0] if refinements and refinements[0].traceable else None


def on_host(plan: Plan, refinements: tuple[Refinement, ...]) -> Iterator[Callable[[Case], Case]]:
    """The steps of refinements that run on the host. After another refinement, one on all points
    is skipped where the network has seen them all: these are the points already refined on."""
    for number, each in enumerate(refinements):
        if each.every_point and (plan.thinned or number == 0):
            yield functools.partial(refine_every_point, refine=each)
        elif not each.every_point and not each.traceable:
            yield functools.partial(refine_used_points, refine=each)


def checked_params(params: Any) -> Params:
    """The weights that ship for None; raises ValueError for what are no parameters, and for a
    calibration made of other clues than `align` finds."""
    params = _default_params() if params is None else params
    check_params(params)
    if (fitted := calibration_of(params)) is not None:
        fitted.check("align", confidence.NAMES)
    return dict(params)


@functools.cache
def _default_params() -> Params:
    return load_params()
