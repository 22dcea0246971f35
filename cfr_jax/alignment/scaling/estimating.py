"""Estimates the factor of scale between two clouds: `align` with `scale="auto"`.

The sizes of the clouds tell the factor roughly; partial views differ by a third. So the network
registers the source at a few sizes around that. Each answer is refined with its factor
(`refine.similarity`), from where most of them end in the same place. Motions are judged by the
distances between all points of both clouds, with the same cut for all of them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cfr_jax.alignment import refining, solving
from cfr_jax.alignment.case import Case
from cfr_jax.alignment.planning import Plan, planned
from cfr_jax.alignment.scaling import ratios
from cfr_jax.alignment.scaling.certainty import certainty
from cfr_jax.alignment.search import search as tried_everywhere
from cfr_jax.geometry import motions, thinning, units
from cfr_jax.io import PointCloud
from cfr_jax.networks.record import Params
from cfr_jax.refine import find, similarity
from cfr_jax.refine.generalized_icp import CUT
from cfr_jax.refine.similarity import Similarity
from cfr_jax.refine.surfaces import HostSurface

# Times the ratio of the sizes of the clouds. On partial pairs of val.h5, that ratio was off by up
# to a quarter, and nearly all starts within a third of the truth ended at the truth.
_TRIED = (1.0, 0.77, 1.3)
_AROUND = (0.8, 1.25)  # times the best factor: from there, the refinement is to come back
_WIDER = (3.0, 2.0, 1.0)  # the cuts of the refinement, times the last one
_MOST = 4096  # points of each cloud that take part in the last refinement
_ERRORS, _NEAR = 3.0, 0.01  # see `_rounded`


class Estimate(NamedTuple):
    """An estimated factor of scale."""

    factor: float
    """What the source is to be multiplied by."""
    confidence: float
    """The probability that the factor is right to 2 percent."""
    motion: Float[np.ndarray, "4 4"]
    """The motion that maps the scaled source onto the target."""


class _Candidate(NamedTuple):
    """A similarity that maps the source of `plan`, which was multiplied by `before`, onto its
    target."""

    before: float
    plan: Plan
    source: HostSurface
    target: HostSurface
    found: Similarity
    misfit: float

    @property
    def factor(self) -> float:
        """What the caller's source is multiplied by."""
        return self.before * self.found.factor

    @property
    def cut(self) -> float:
        """The usual inlier distance, but in radii of the target: the same for all candidates."""
        return _cut(self.plan)


def estimated(
    params: Params,
    source: PointCloud,
    target: PointCloud,
    *,
    everywhere: bool = False,
    max_points: int | None = None,
    seed: int = 0,
    search: bool = True,
) -> Estimate:
    """The factor of scale of the source, how likely it is right, and the motion that goes with it.

    A factor as close to a ratio of usual units as the estimate is precise is taken to be that
    ratio. `everywhere` searches all rotations. The other options are those of `planned`. Raises
    ValueError like `planned`.
    """
    rough = 1 / units.unit_frames(source, target, None).size_ratio

    def solved(factor: float) -> _Candidate:
        plan = planned(
            multiplied(source, factor),
            target,
            initial="global" if everywhere else None,
            max_points=max_points,
            seed=seed,
            whole=True,
            search=search,
        )
        case = Case(params, plan)
        if everywhere:
            case = tried_everywhere(case)
        case = solving.solve_case(case, refine=find(True))
        found = np.asarray(case.solved().transform, np.float64)
        start = Similarity(1.0, plan.frames.to_unit(case.plan.frames.to_caller(found)))
        return _refined(_Candidate(factor, plan, *refining.used_points(plan), start, math.inf))

    tried = [solved(times * rough) for times in _TRIED]
    best = min(tried, key=lambda each: each.misfit)
    told = certainty(best.source, best.target, best.found, best.cut)
    around = [_refined(best._replace(found=told.changed(best.found, times))) for times in _AROUND]
    spread = max(abs(math.log(each.factor / best.factor)) for each in around)
    best = min([*tried, *around], key=lambda each: each.misfit)
    told = certainty(best.source, best.target, best.found, best.cut)
    factor = _rounded(_polished(best), told.error)
    return Estimate(factor, told.confidence(spread), _motion(best, factor))


def _motion(best: _Candidate, factor: float) -> Float[np.ndarray, "4 4"]:
    """The best motion for the caller's source multiplied by `factor`: it carries the center of the
    source to the same place."""
    frames, rotation = best.plan.frames, best.found.motion[:3, :3]
    place = frames.target_center + frames.scale * best.found.motion[:3, 3]
    center = factor / best.before * frames.source_center
    return motions.motion(rotation, place - rotation @ center)


def multiplied(cloud: PointCloud, factor: float) -> PointCloud:
    """The cloud with all coordinates multiplied by a factor; itself for 1."""
    return cloud if factor == 1 else PointCloud(factor * cloud.points, cloud.normals, cloud.name)


def _refined(candidate: _Candidate) -> _Candidate:
    sides, cut = (candidate.source, candidate.target), candidate.cut
    cuts = tuple(times * cut for times in _WIDER)
    found = similarity.refine(*sides, candidate.found, cuts=cuts)
    return candidate._replace(found=found, misfit=similarity.misfit(*sides, found, cut))


def _cut(plan: Plan) -> float:
    return CUT * min(1.0, 1 / plan.frames.size_ratio)


def _polished(best: _Candidate) -> float:
    """The factor of the best candidate after a last refinement with more points."""
    if not best.plan.thinned:
        return best.factor
    source, target = (_thinned(side) for side in refining.every_point(best.plan))
    found = similarity.refine(source, target, best.found, cuts=(best.cut,))
    return best.before * found.factor


def _thinned(surface: HostSurface) -> HostSurface:
    rows = thinning.subsample(surface.points, _MOST, seed=0)
    normals = None if surface.normals is None else surface.normals[rows]
    return HostSurface(surface.points[rows], normals)


def _rounded(factor: float, error: float) -> float:
    """The nearest ratio of usual units, if that is within three standard errors of the factor and
    within one percent; else the factor."""
    ratio = ratios.nearest(factor).factor
    near = abs(math.log(factor / ratio)) <= min(_ERRORS * error, _NEAR)
    return ratio if near else factor
