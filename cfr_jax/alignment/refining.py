"""Runs refinements on the host: gives them the clouds of a case and puts their answer into it."""

from __future__ import annotations

import dataclasses
import time

import jax
import numpy as np
from jaxtyping import Float

from cfr_jax.alignment import measuring, solving
from cfr_jax.alignment.case import Case, Placed
from cfr_jax.alignment.planning import Plan
from cfr_jax.geometry import motions
from cfr_jax.geometry.units import UnitCloud
from cfr_jax.io import PointCloud
from cfr_jax.refine import Refinement
from cfr_jax.refine.surfaces import HostSurface


def refine_used_points(case: Case, *, refine: Refinement) -> Case:
    """Refines the case on the points that the network saw. The result is kept unless it fits
    worse."""
    began = time.perf_counter()
    plan, found = case.plan, case.solved()
    fit = refine(*used_points(plan), np.asarray(found.transform, np.float64))
    case.seconds["run"] += time.perf_counter() - began
    sides = solving.on_device(plan.source, plan.target)
    told = np.asarray(fit.transform, np.float32), np.asarray(fit.converged)
    found = solving.timed(
        case.seconds, solving.replaced, *sides, found, *told, np.asarray(fit.steps, np.int32)
    )
    return dataclasses.replace(case, found=jax.device_get(found))


def refine_every_point(case: Case, *, refine: Refinement) -> Case:
    """Refines the case on all points of the caller's clouds, and measures its quality on them.

    The clues of the confidence and the free directions are not measured again. They keep their
    values from the points that the network saw, because they depend on the density of a cloud.
    """
    began = time.perf_counter()
    case = placed(case)
    found = case.solved()
    fit = refine(*surfaces(case), to_placed(case, np.asarray(found.transform)))
    transform = _of_plan(case, np.asarray(fit.transform, np.float64))
    found = dataclasses.replace(
        found,
        transform=transform,
        improved=found.improved | np.asarray(fit.improved),
        converged=np.asarray(fit.converged),
        steps=found.steps + np.asarray(fit.steps, np.int32),
    )
    case = measured(dataclasses.replace(case, found=found))
    case.seconds["run"] += time.perf_counter() - began
    return case


def measured(case: Case) -> Case:
    """The case with the quality of its motion measured on the `placed` clouds."""
    found = case.solved()
    transform = to_placed(case, np.asarray(found.transform))
    told = measuring.measure(*surfaces(case), transform, solving.DISTANCE)
    quality = dataclasses.replace(found.quality, **vars(told))
    return dataclasses.replace(case, found=dataclasses.replace(found, quality=quality))


def misfit(case: Case, transform: Float[np.ndarray, "4 4"] | None = None) -> float:
    """The `measuring.misfit` of a `placed` case's answer, or of another motion `transform` between
    its unit clouds."""
    if transform is None:
        transform = np.asarray(case.solved().transform)
    return measuring.misfit(*surfaces(case), to_placed(case, transform), solving.DISTANCE)


def placed(case: Case) -> Case:
    """The case with its clouds on the host. They are made once and kept for other starts of this
    pair."""
    if case.placed is not None:
        return case
    plan = case.plan
    sides = used_points(plan) if plan.whole is None else every_point(plan)
    return dataclasses.replace(case, placed=Placed(*sides, plan.frames))


def surfaces(case: Case) -> tuple[HostSurface, HostSurface]:
    """The source and the target of a `placed` case."""
    assert case.placed is not None
    return case.placed.source, case.placed.target


def to_placed(case: Case, transform: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Converts a motion between the plan's unit clouds to one between the `placed` clouds."""
    assert case.placed is not None
    transform = np.asarray(transform, np.float64)
    if case.placed.frames is case.plan.frames:
        return transform
    return case.placed.frames.to_unit(case.plan.frames.to_caller(transform))


def _of_plan(case: Case, transform: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Converts a motion between the `placed` clouds to one between the plan's unit clouds."""
    assert case.placed is not None
    if case.placed.frames is case.plan.frames:
        return transform
    return case.plan.frames.to_unit(case.placed.frames.to_caller(transform))


def used_points(plan: Plan) -> tuple[HostSurface, HostSurface]:
    """The points of both clouds that the network sees."""
    return _used(plan.source), _used(plan.target)


def _used(unit: UnitCloud) -> HostSurface:
    normals = None if unit.normals is None else unit.normals[unit.mask].astype(np.float64)
    return HostSurface(unit.points[unit.mask].astype(np.float64), normals)


def every_point(plan: Plan) -> tuple[HostSurface, HostSurface]:
    """All points of both clouds, in the same frames as the plan's unit clouds."""
    assert plan.whole is not None, "planned with `whole`"
    frames = plan.frames
    sides = (
        (plan.whole[0], plan.source, frames.source_center, frames.initial),
        (plan.whole[1], plan.target, frames.target_center, np.eye(4)),
    )
    source, target = (
        _placed(cloud, len(unit.rows), center, frames.scale, motion)
        for cloud, unit, center, motion in sides
    )
    return source, target


def _placed(
    cloud: PointCloud, used: int, center: np.ndarray, scale: float, motion: np.ndarray
) -> HostSurface:
    points = (motions.apply(motion, cloud.points) - center) / scale
    normals = None if cloud.normals is None else motions.rotate(motion, cloud.normals)
    placed = PointCloud(points, normals)
    return HostSurface(placed.points, placed.normals, used)
