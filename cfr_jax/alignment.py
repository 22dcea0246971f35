"""`align`: two clouds of one thing, any size, units and offset, and the motion between them."""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from cfr_jax import confidence, doubts, pyramid, solving
from cfr_jax.planning import Plan, planned, read_clouds
from cfr_jax.weights import load_params


@dataclass(frozen=True)
class Alignment:
    """Answer of `align`; everything in the caller's frame and units."""

    transform: Float[np.ndarray, "4 4"]
    """Maps source onto target: `transform @ [x; 1]` lies on the target. Float64."""
    transforms: Float[np.ndarray, "L 4 4"]
    """What the network answered, one per iteration, before any refinement."""
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
    refine: bool = True,
    initial: Float[np.ndarray, "4 4"] | None = None,
    max_points: int | None = None,
    all_points: bool = False,
    seed: int = 0,
) -> Alignment:
    """Finds the rigid motion that lays `source` on `target`.

    Clouds are (n, 3) arrays, (n, 6) with normals, paths, or what else `io.as_point_cloud` takes.
    They are centered and scaled in float64, thinned to `max_points` each (default 1,024; `seed`
    says which), given normals where they have none, registered by the network with `params`
    (default: the weights that ship) and refined (`refinement.refine`; off with `refine=False`).
    With `all_points` it is refined further on every point there is (`pyramid`); `fitness` and
    `inlier_rmse` are then of all points, too.

    `initial` (4, 4) moves the source close to the target first; without it the centroids are laid
    on each other. The network is trained for up to 45 degrees about each axis from there. The same
    call gives the same answer, to the bit, on the same machine.

    Raises ValueError for clouds without extent or with fewer than 3 points, wrong shapes, values
    that are not finite, and an `initial` that is no rigid motion or leaves the clouds far apart;
    `io.CloudFileError` for files.
    """
    began = time.perf_counter()
    if all_points and not refine:
        raise ValueError(
            "all_points: got True with refine=False, wanted a refinement to go on from"
        )
    source, target = read_clouds(source, target)
    plan = planned(source, target, initial=initial, max_points=max_points, seed=seed)
    params = checked_params(params)
    arguments = params, solving.on_device(plan.source), solving.on_device(plan.target)
    started = time.perf_counter()
    program = solving.compiled(solving.solve_pair, *arguments, refine=refine)
    compiled = time.perf_counter()
    found = jax.block_until_ready(program(*arguments))
    if all_points:
        found = pyramid.on_all_points(plan, source, target, found)
    done = time.perf_counter()
    seconds = {"compile": compiled - started, "run": done - compiled, "total": done - began}
    return answer(plan, found, seconds)


def answer(plan: Plan, found: solving.Found, seconds: dict[str, float]) -> Alignment:
    """What the device found of a plan, in the caller's frame and units, and how far to trust it."""
    frames = plan.frames
    resistance = np.asarray(found.quality.resistance)
    determined = bool(resistance.min() >= doubts.FREE)
    weakest = np.asarray(found.quality.weakest)[resistance.argmin()]
    fitness = float(found.quality.fitness)
    clues = {name: float(value) for name, value in vars(found.clues).items()}
    probability = confidence.of_alignment(clues)
    neighbors = min(plan.source.neighbors.shape[1], plan.target.neighbors.shape[1])
    return Alignment(
        transform=frames.to_caller(np.asarray(found.transform)),
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
            None if determined else weakest, probability, fitness, neighbors, frames.size_ratio
        ),
        seconds=seconds,
    )


def checked_params(params: Any) -> dict:
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
