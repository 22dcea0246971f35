"""`align`: two clouds of one thing, any size, units and offset, and the motion between them."""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from cfr_jax import confidence, doubts, pyramid, quality, refinement, search, solving
from cfr_jax.baselines import gicp
from cfr_jax.baselines.optional import require
from cfr_jax.planning import Plan, planned, read_clouds, rigid_motions
from cfr_jax.search import Search
from cfr_jax.second_look import look_again
from cfr_jax.weights import load_params

Initial = Float[np.ndarray, "4 4"] | Float[np.ndarray, "k 4 4"] | Literal["global"] | None


@dataclass(frozen=True)
class Alignment:
    """Answer of `align`; everything in the caller's frame and units."""

    transform: Float[np.ndarray, "4 4"]
    """Maps source onto target: `transform @ [x; 1]` lies on the target. Float64."""
    transforms: Float[np.ndarray, "L 4 4"]
    """What the network answered, one per iteration of its two cascades, before any refinement."""
    refined: bool
    """Whether `transform` is not the network's last, but an answer that fits no worse: the
    refinement's, or the start where that fits better still."""
    confidence: float
    """Estimated probability, in [0, 1], that the motion is right to 5 degrees and 0.1 radii."""
    clues: dict[str, float]
    """What the confidence was estimated from (`confidence.Clues`)."""
    determined: bool
    """Whether the clouds determine the motion; false where one slides or turns on the other."""
    fitness: float
    """Share of the source that has a target point within `inlier_distance`."""
    inlier_rmse: float
    """Root mean square distance of those points."""
    inlier_distance: float
    weights: Float[np.ndarray, " n"]
    """How much of each used source point found a partner, in [0, 1]."""
    source_rows: Int[np.ndarray, " n"]
    """Which source points the network saw."""
    target_rows: Int[np.ndarray, " m"]
    neighbors: int
    """Neighbors per point; small clouds have fewer than the usual 64."""
    warnings: tuple[str, ...]
    """Why the answer should not be trusted, or what was done differently, in words."""
    seconds: dict[str, float]
    """`compile` (zero when a program of this size was there already), `run`, and `total`."""
    converged: bool = False
    """Whether the refinement ended because nothing moved any more; false without one."""
    steps: int = 0
    """How many steps the refinement took."""
    overlap: float = 0.0
    """Estimated share of the source that the target saw, too."""
    information: Float[np.ndarray, "6 6"] = field(default_factory=lambda: np.zeros((6, 6)))
    """Information matrix of the inliers among the used points, as Open3D's
    `get_information_matrix_from_point_clouds` gives it: rotation first, about the origin of the
    target's frame."""
    initial: Float[np.ndarray, "4 4"] | None = None
    """Where the network started, in the caller's frame: as given, or as a search found it."""
    starts: int = 1
    """How many starts were tried, or looked at a second time."""
    alternatives: Float[np.ndarray, "a 4 4"] = field(default_factory=lambda: np.zeros((0, 4, 4)))
    """Other motions that a search found to fit about as well: the shape is nearly symmetric."""

    @property
    def trusted(self) -> bool:
        """Whether the motion is determined and more likely right than wrong."""
        return self.determined and self.confidence >= doubts.TRUSTED

    def to_open3d(self) -> Any:
        """The answer as an `open3d.pipelines.registration.RegistrationResult`.

        `transformation`, `fitness` and `inlier_rmse` mean in Open3D what they mean here:
        `source.transform(result.to_open3d().transformation)` lays the source on the target. The
        correspondences are soft here, so that `correspondence_set` stays empty. Raises
        ModuleNotFoundError without Open3D.
        """
        try:
            from open3d.pipelines.registration import RegistrationResult
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(
                'to_open3d needs Open3D: pip install "cfr_jax[baselines]"', name="open3d"
            ) from error
        result = RegistrationResult()
        result.transformation = self.transform
        result.fitness, result.inlier_rmse = self.fitness, self.inlier_rmse
        return result


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
    (default: the weights that ship) in two cascades, and refined by `refinement.refine`, by the
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


def answer(
    plan: Plan, found: solving.Found, seconds: dict[str, float], searched: Search | None = None
) -> Alignment:
    """What the device found of a plan, in the caller's frame and units, and how far to trust it.

    `searched` is the search that the plan's start came from, if there was one.
    """
    frames = plan.frames
    transform = frames.to_caller(np.asarray(found.transform))
    initial = None if np.array_equal(frames.initial, np.eye(4)) else frames.initial
    far = None if searched is None or searched.nearby else searched
    rivals = np.zeros((0, 4, 4)) if far is None else far.rivals(transform)
    resistance = np.asarray(found.quality.resistance)
    determined = bool(resistance.min() >= doubts.FREE)
    weakest = np.asarray(found.quality.weakest)[resistance.argmin()]
    fitness = float(found.quality.fitness)
    clues = {name: float(value) for name, value in confidence.named(found.clues).items()}
    probability = doubts.probability(clues, fitness)
    neighbors = min(plan.source.neighbors.shape[1], plan.target.neighbors.shape[1])
    return Alignment(
        transform=transform,
        transforms=frames.to_caller(np.asarray(found.registration.transforms)),
        refined=bool(found.improved),
        converged=bool(found.converged),
        steps=int(found.steps),
        confidence=probability,
        clues=clues,
        determined=determined,
        fitness=fitness,
        inlier_rmse=float(found.quality.inlier_rmse) * frames.scale,
        inlier_distance=solving.DISTANCE * frames.scale,
        weights=np.asarray(found.registration.weights, np.float64)[: len(plan.source.rows)],
        source_rows=plan.source.rows,
        target_rows=plan.target.rows,
        neighbors=neighbors,
        warnings=doubts.warnings_of(
            None if determined else weakest,
            doubts.turns(transform, rivals),
            probability,
            fitness,
            neighbors,
            frames.size_ratio,
            far is not None,
        ),
        seconds=seconds,
        initial=initial,
        starts=1 if searched is None else searched.starts,
        alternatives=rivals,
        overlap=float(found.quality.overlap),
        information=quality.information_matrix(
            np.asarray(found.quality.moments), frames.target_center, frames.scale
        ),
    )


def _by_small_gicp(plan, clouds, solved, seconds):
    began = time.perf_counter()
    source, target = (
        unit.points[unit.mask].astype(np.float64) for unit in (plan.source, plan.target)
    )
    start = np.asarray(solved.transform, np.float64)
    cuts = tuple(stage.cut for stage in refinement.STAGES)
    found = gicp.descend(source, target, start, cuts)
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
