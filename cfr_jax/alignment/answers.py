"""The answer of `align`: the motion in the caller's frame and units, and how far to trust it."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from cfr_jax.alignment import basins, confidence, doubts, measuring, quality, search, solving
from cfr_jax.alignment.case import Case
from cfr_jax.geometry import motions
from cfr_jax.networks.probability import calibration_of
from cfr_jax.refine.similarity import Similarity
from cfr_jax.runtime.values import ByValue

_REACH = 90.0  # degrees: turns by up to 45 about each of three axes stay within


@dataclass(frozen=True, eq=False)
class Alignment(ByValue):
    """The answer of `align`. Everything is in the caller's frame and units.

    `fitness`, `inlier_rmse`, `overlap` and `information` are measured on all points if a refinement
    used all points, and otherwise on the points that the network saw. `clues` always come from the
    points that the network saw.
    """

    transform: Float[np.ndarray, "4 4"]
    """Maps source onto target: `transform @ [x; 1]` lies on the target. Float64. With a `scale`
    other than 1, it is still rigid, and maps the scaled source: `transform @ [scale * x; 1]`. So do
    all other motions here."""
    transforms: Float[np.ndarray, "L 4 4"]
    """The network's answers before any refinement, one per iteration of its two cascades."""
    refined: bool
    """Whether `transform` differs from the network's last answer. It is then the refined motion, or
    a start that fits better still; neither fits worse than the network's answer."""
    confidence: float | None
    """The estimated probability, in [0, 1], that the motion is right to 5 degrees and 0.1 radii.
    None if the weights carry no calibration."""
    clues: dict[str, float]
    """The numbers from which the confidence was estimated (`confidence.Clues`)."""
    determined: bool
    """Whether the clouds determine the motion. False if one can slide or turn on the other."""
    fitness: float
    """The share of source points that have a target point within `inlier_distance`."""
    inlier_rmse: float
    """The root mean square distance from these source points to their closest target points."""
    inlier_distance: float
    weights: Float[np.ndarray, " n"]
    """The weight of each source point that the network saw, in [0, 1]: how much of it found a
    partner."""
    source_rows: Int[np.ndarray, " n"]
    """The rows of the source points that the network saw."""
    target_rows: Int[np.ndarray, " m"]
    """The rows of the target points that the network saw."""
    neighbors: int
    """The number of neighbors per point. Small clouds have fewer than the usual 64."""
    warnings: tuple[str, ...]
    """Sentences that say why the answer should not be trusted, or what was done differently."""
    seconds: dict[str, float]
    """`compile` (zero if a program of this size existed already), `run`, and `total`."""
    converged: bool = False
    """Whether the refinement ended because nothing moved any longer. False without refinement."""
    steps: int = 0
    """The number of steps that the refinement took."""
    overlap: float = 0.0
    """The estimated share of the source that the target shows, too."""
    information: Float[np.ndarray, "6 6"] = field(default_factory=lambda: np.zeros((6, 6)))
    """The information matrix of the inliers, as `get_information_matrix_from_point_clouds` of
    Open3D defines it: rotation first, about the origin of the target's frame."""
    initial: Float[np.ndarray, "4 4"] | None = None
    """The motion from which the network started, in the caller's frame, whether given or found by a
    search. None if nothing moved the source before the network."""
    starts: int = 1
    """The number of starts that were tried, including those of a second look."""
    alternatives: Float[np.ndarray, "a 4 4"] = field(default_factory=lambda: np.zeros((0, 4, 4)))
    """Other motions that fit about as well or better. They were found by a search or, if the answer
    would be trusted, by turning it far. If there are any, the shape is nearly symmetric."""

    scale: float = 1.0
    """What the points of the source were multiplied by: 1, the number that the caller gave, or, for
    `scale="auto"`, the factor that was estimated."""
    scale_confidence: float | None = None
    """The estimated probability, in [0, 1], that an estimated `scale` is right to 2 percent, if the
    motion is right. None if it was not estimated."""

    _not_compared = ("seconds",)

    @property
    def similarity(self) -> Float[np.ndarray, "4 4"]:
        """Maps source onto target with its scale: `similarity @ [x; 1]` lies on the target. Equal
        to `transform` if `scale` is 1."""
        return Similarity(self.scale, self.transform).matrix

    @property
    def trusted(self) -> bool:
        """Whether the clouds determine the motion and it is more likely right than wrong. False if
        the confidence is unknown, if `alternatives` fit about as well, or if the scale was
        estimated and is in doubt."""
        if self.confidence is None or len(self.alternatives):
            return False
        if self.scale_confidence is not None and not doubts.trusted(self.scale_confidence):
            return False
        return self.determined and doubts.trusted(self.confidence)

    def to_open3d(self) -> Any:
        """The answer as an `open3d.pipelines.registration.RegistrationResult`.

        `transformation`, `fitness` and `inlier_rmse` mean the same in Open3D as here:
        `source.transform(result.to_open3d().transformation)` lays the source on the target. The
        correspondences here are soft, so `correspondence_set` stays empty. Raises
        ModuleNotFoundError if Open3D is not installed.
        """
        try:
            from open3d.pipelines.registration import RegistrationResult
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(
                'to_open3d needs Open3D: pip install "cfr_jax[baselines]"', name="open3d"
            ) from error
        result = RegistrationResult()
        result.transformation = self.similarity
        result.fitness, result.inlier_rmse = self.fitness, self.inlier_rmse
        return result


def answer(case: Case) -> Alignment:
    """Turns a solved case into the answer in the caller's frame and units."""
    plan, found, searched = case.plan, case.solved(), case.searched
    frames = plan.frames
    transform = frames.to_caller(np.asarray(found.transform))
    initial = None if np.array_equal(frames.initial, np.eye(4)) else frames.initial
    far = None if searched is None or searched.nearby else searched
    rivals = np.zeros((0, 4, 4)) if far is None else search.rivals(far, transform)
    fitness = float(found.quality.fitness)
    clues = confidence.named(found.clues)
    likely = functools.partial(
        doubts.probability,
        calibration_of(case.params),
        clues,
        fitness,
        fitness * len(plan.source.rows),
    )
    probability, free = likely(len(rivals)), left_open(case)
    if free is None and doubts.trusted(probability):
        around = surroundings(case)
        free = around.free_turn()
        if free is None and not len(rivals):
            rivals = frames.to_caller(around.rivals())
            probability = likely(len(rivals))
    neighbors = min(plan.source.neighbor_count, plan.target.neighbor_count)
    return Alignment(
        transform=transform,
        transforms=frames.to_caller(np.asarray(found.registration.transforms)),
        refined=bool(found.improved),
        converged=bool(found.converged),
        steps=int(found.steps),
        confidence=probability,
        clues=clues,
        determined=free is None,
        fitness=fitness,
        inlier_rmse=float(found.quality.inlier_rmse) * frames.scale,
        inlier_distance=solving.DISTANCE * frames.scale,
        weights=np.asarray(found.registration.weights, np.float64)[: len(plan.source.rows)],
        source_rows=plan.source.rows,
        target_rows=plan.target.rows,
        neighbors=neighbors,
        warnings=doubts.warnings_of(
            free,
            doubts.turns(transform, rivals),
            probability,
            fitness,
            neighbors,
            frames.size_ratio,
            far is not None,
            plan.remarks,
            plan.spacing_ratio,
        )
        + doubts.of_scale(plan.scale_confidence),
        scale=plan.scale,
        scale_confidence=plan.scale_confidence,
        seconds=case.seconds,
        initial=initial,
        starts=1 if searched is None else searched.starts,
        alternatives=rivals,
        overlap=float(found.quality.overlap),
        information=quality.information_matrix(
            np.asarray(found.quality.moments), frames.target_center, frames.scale
        ),
    )


def left_open(case: Case) -> Float[np.ndarray, " 6"] | None:
    """A twist that the clouds do not determine, or None if nudges find none.

    If a nudge of the usual size finds a direction free, this direction is tested again with a nudge
    whose size suits the clouds (`measuring.resistance`).
    """
    found = case.solved()
    resistance = np.asarray(found.quality.resistance, np.float64)
    twists, transform = (
        np.asarray(value, np.float64) for value in (found.quality.weakest, found.transform)
    )
    free = resistance < doubts.FREE
    if free.any():
        resistance[free] = measuring.resistance(*_used(case), transform, twists[free])
    return twists[resistance.argmin()] if resistance.min() < doubts.FREE else None


def surroundings(case: Case) -> basins.Surroundings:
    """Where other motions may fit as well as the answer, in the unit sphere.

    Without a search over all rotations, the answer is taken to lie within the network's reach of
    where the source was given, and so are its rivals.
    """
    frames, searched = case.plan.frames, case.searched
    first, within = frames, _REACH
    if searched is not None:
        first, within = searched.frames, _REACH if searched.nearby else 180.0
    start = motions.motion(first.initial[:3, :3] @ frames.initial[:3, :3].T)
    transform = np.asarray(case.solved().transform, np.float64)
    return basins.Surroundings(*_used(case), transform, start=start, within=within)


def _used(case: Case) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "m 3"]]:
    """The points that the network saw, in the unit sphere."""
    source, target = (
        unit.points[unit.mask].astype(np.float64) for unit in (case.plan.source, case.plan.target)
    )
    return source, target
