"""`align`: two clouds of one thing, any size, units and offset, and the motion between them."""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from cfr_jax.alignment import pyramid, search, solving
from cfr_jax.alignment.answers import Alignment, answer
from cfr_jax.alignment.planning import planned, read_clouds, rigid_motions
from cfr_jax.alignment.second_look import look_again
from cfr_jax.refine import generalized_icp, small_gicp
from cfr_jax.runtime.optional import require
from cfr_jax.weights.files import load_params

Initial = Float[np.ndarray, "4 4"] | Float[np.ndarray, "k 4 4"] | Literal["global"] | None


def align(
    source: Any,
    target: Any,
    *,
    params: dict | None = None,
    refine: bool | Literal["small_gicp"] = True,
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
    (default: the weights that ship) in two cascades, and refined by our generalized ICP, by the
    library small_gicp (`refine="small_gicp"`), or not at all (False). Refining never makes the
    score worse. With `all_points` it is refined further on every point there is (`pyramid`);
    `fitness` and `inlier_rmse` are then of all points, too.

    `initial` (4, 4) moves the source close to the target first; without it the centroids are laid
    on each other. The network is trained for up to 45 degrees about each axis from there. Several
    (k, 4, 4) are all tried on thinned clouds, and the one from which the clouds come to lie best on
    each other is taken; "global" tries a cover of all rotations (`search`), which takes some
    times as long, and tells of other motions that fit about as well. Without `initial`, a refined
    answer that is not to be trusted gets a `second_look`: some starts around the first are tried in
    the same way, and what is more likely right is kept. The same call gives the same answer, to the
    bit, on the same machine.

    Raises ValueError for clouds without extent or with fewer than 3 points, wrong shapes, values
    that are not finite, and an `initial` that is no rigid motion or leaves the clouds far apart;
    `io.CloudFileError` for files; ModuleNotFoundError for small_gicp without that library.
    """
    began = time.perf_counter()
    if refine not in (True, False, "small_gicp"):
        raise ValueError(f'refine: got {refine!r}, wanted True, False or "small_gicp"')
    if refine == "small_gicp":
        require("small_gicp")  # before anything is computed
    if all_points and not refine:
        raise ValueError(
            "all_points: got True with refine=False, wanted a refinement to go on from"
        )
    source, target = read_clouds(source, target)
    params = checked_params(params)
    seconds = {"compile": 0.0, "run": 0.0}
    thinned = {"max_points": max_points, "seed": seed}
    searched = None
    everywhere = isinstance(initial, str) and initial == "global"
    motions = None if initial is None or everywhere else rigid_motions(initial)
    several = everywhere or (motions is not None and len(motions) > 1)
    plan = planned(source, target, initial=None if several else initial, **thinned)
    if several:
        starts = search.everywhere() if everywhere else search.given(plan.frames, motions)
        searched = search.search(params, plan, starts, seconds=seconds)
        plan = plan.started_at(searched.unit_motions[0])
    arguments = params, solving.on_device(plan.source), solving.on_device(plan.target)
    solved = solving.timed(seconds, solving.solve_pair, *arguments, refine=refine is True)
    if refine is True and second_look and not several:
        plan, solved, searched = look_again(params, plan, solved, seconds=seconds)
    if refine == "small_gicp":
        solved = _by_small_gicp(plan, arguments[1:], solved, seconds)
    if all_points:
        further = time.perf_counter()
        solved = pyramid.on_all_points(plan, source, target, solved)
        seconds["run"] += time.perf_counter() - further
    seconds["total"] = time.perf_counter() - began
    return answer(plan, solved, seconds, searched)


def _by_small_gicp(plan, clouds, solved, seconds):
    began = time.perf_counter()
    source, target = (
        unit.points[unit.mask].astype(np.float64) for unit in (plan.source, plan.target)
    )
    start = np.asarray(solved.transform, np.float64)
    cuts = tuple(stage.cut for stage in generalized_icp.STAGES)
    found = small_gicp.descend(source, target, start, cuts)
    seconds["run"] += time.perf_counter() - began
    told = jnp.asarray(found.motion, jnp.float32), jnp.array(found.converged)
    return solving.timed(
        seconds, solving.replaced, *clouds, solved, *told, jnp.array(found.steps, jnp.int32)
    )


def checked_params(params: Any) -> Mapping:
    """The weights that ship for None; raises ValueError for what are no parameters."""
    params = _default_params() if params is None else params
    if not isinstance(params, Mapping):
        raise ValueError(
            f"params: got a {type(params).__name__}, wanted the parameters of load_params"
        )
    return params


@functools.cache
def _default_params():
    return load_params()
