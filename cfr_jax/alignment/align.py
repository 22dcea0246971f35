"""`align` finds the motion between two clouds of one thing, of any size, units and offset."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator
from typing import Any

from cfr_jax.alignment import confidence
from cfr_jax.alignment.answers import Alignment, answer
from cfr_jax.alignment.case import Case
from cfr_jax.alignment.planning import Initial, Plan
from cfr_jax.alignment.refining import refine_every_point, refine_used_points
from cfr_jax.alignment.scaling.planning import Scale, planned_at_scale
from cfr_jax.alignment.search import search
from cfr_jax.alignment.second_look import keep_start, look_again, look_everywhere
from cfr_jax.alignment.solving import on_accelerator, solve_case
from cfr_jax.networks.cfr.network import check_params
from cfr_jax.networks.probability import calibration_of
from cfr_jax.networks.record import Params
from cfr_jax.refine import Refine, Refinement, find
from cfr_jax.runtime.entries import entry
from cfr_jax.weights.files import load_params


@entry
def align(
    source: Any,
    target: Any,
    *,
    params: Params | None = None,
    refine: Refine = True,
    initial: Initial = None,
    max_points: int | None = None,
    all_points: bool = True,
    second_look: bool = True,
    scale: Scale = 1.0,
    seed: int = 0,
) -> Alignment:
    """Finds the rigid motion that moves `source` onto `target`.

    The clouds may have any size and offset, and any unit that is the same for both; for different
    units, see `scale`. They are centered and scaled in float64, and thinned. The network registers
    them in two cascades, and a local refinement makes its answer precise. The same call gives the
    same answer, bit by bit, on the same machine. There is no gradient, of the motion or of an
    estimated scale; `register` has one, also with regard to a factor that its source is multiplied
    by.

    Args:
        source: The cloud that moves: an (n, 3) array, an (n, 6) array with normals, a path, or
            anything else that `io.as_point_cloud` accepts. Missing normals are estimated.
        target: The cloud that stays, likewise.
        params: The network's weights, as `load_params` returns them (default: the shipped ones).
        refine: How the network's answer is refined: True for the generalized ICP of this package,
            False for not at all, or another name in the table of `cfr_jax.refine`, such as
            "small_gicp", or "module:function". A refinement that makes the fit worse is dropped.
        initial: Where to start. The network is trained for rotations of up to 45 degrees about each
            axis from the start.
            None: the centroids are moved onto each other.
            A (4, 4) array: a rough guess of the answer. It is also refined without the network, and
            that answer is kept if the clouds fit better with it.
            A (k, 4, 4) array: several guesses. The best of them on thinned clouds is the start.
            "global": starts that cover all rotations are tried, too. This takes several times as
            long. The motion found is taken if it is clearly better than the answer without these
            starts. Other motions that fit about as well are reported in `alternatives`.
            "auto": the same, but only if the confidence in the first answer is below one half.
        max_points: How many points of each cloud the network sees at most (default: 1,024).
        all_points: Whether a last refinement uses all points of clouds that were thinned. Then
            `fitness`, `inlier_rmse`, `overlap` and `information` are measured on all points, too.
        second_look: Whether an answer that is not trusted is compared with answers from other
            starts: the identity, and rotations around the first start. The one that is more likely
            right is kept. Without effect if `initial` is given, or if the weights have no
            calibration, which tells the better answer.
        scale: What the points of the source are multiplied by before anything else.
            A number: for example 0.001 if the source is in millimeters and the target in meters.
            "auto": the factor is estimated. This takes about four times as long. The answer is
            trusted only if the shapes determine the factor: planes, cones, or the corner of a room
            do not, and two cubes of different size are taken for one. `initial` may then be no
            array, because it moves the scaled source.
        seed: Which points are kept when a cloud is thinned.

    Returns:
        An `Alignment`. Read `transform` (4, 4), `trusted` and `warnings` first. The transform maps
        source onto target, in the unit and the frames of the clouds: `T @ [x; 1]`. It is rigid with
        any `scale`, and maps the scaled source; `similarity` (4, 4) includes the scale.

    Raises:
        ValueError: A cloud has no extent or fewer than 3 points. A shape is wrong. A value is not
            finite. `initial` is not a rigid motion, or leaves the clouds far apart. `scale` is not
            a positive number or "auto".
        CloudFileError: A file cannot be read.
        ModuleNotFoundError: The library that `refine` needs is missing.
    """
    began = time.perf_counter()
    refinements = chosen_refinements(refine, all_points=all_points)
    weights = checked_params(params)
    plan = planned_at_scale(
        weights,
        source,
        target,
        scale=scale,
        initial=initial,
        max_points=max_points,
        seed=seed,
        whole=any(each.every_point for each in refinements),
        search=not on_accelerator(),
    )
    case = Case(weights, plan)
    for step in steps(plan, refinements, second_look=second_look):
        case = step(case)
    case.seconds["total"] = time.perf_counter() - began
    return answer(case)


def chosen_refinements(refine: Refine, *, all_points: bool = True) -> tuple[Refinement, ...]:
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
