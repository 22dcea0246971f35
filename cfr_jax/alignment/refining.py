"""Refinements that run on the host: what they get of a case, and what becomes of their fit."""

from __future__ import annotations

import dataclasses
import time

import jax.numpy as jnp
import numpy as np

from cfr_jax.alignment import solving
from cfr_jax.alignment.case import Case
from cfr_jax.alignment.planning import Plan
from cfr_jax.geometry import motions
from cfr_jax.geometry.units import UnitCloud
from cfr_jax.io import PointCloud
from cfr_jax.refine import Refinement
from cfr_jax.refine.surfaces import HostSurface


def refine_used_points(case: Case, *, refine: Refinement) -> Case:
    """The case refined on the points that the network saw, unless it fits worse then."""
    began = time.perf_counter()
    plan, found = case.plan, case.solved()
    surfaces = _used(plan.source), _used(plan.target)
    fit = refine(*surfaces, np.asarray(found.transform, np.float64))
    case.seconds["run"] += time.perf_counter() - began
    sides = solving.on_device(plan.source), solving.on_device(plan.target)
    told = jnp.asarray(fit.transform, jnp.float32), jnp.asarray(fit.converged)
    found = solving.timed(
        case.seconds, solving.replaced, *sides, found, *told, jnp.array(fit.steps, jnp.int32)
    )
    return dataclasses.replace(case, found=found)


def refine_every_point(case: Case, *, refine: Refinement) -> Case:
    """The case refined on all points of the caller's clouds; fitness and inlier error are then
    measured on them, too."""
    began = time.perf_counter()
    found = case.solved()
    fit = refine(*_every(case.plan), np.asarray(found.transform, np.float64))
    measured = {
        name: jnp.asarray(value, jnp.float32)
        for name, value in (("fitness", fit.fitness), ("inlier_rmse", fit.inlier_rmse))
        if value is not None
    }
    found = dataclasses.replace(
        found,
        transform=jnp.asarray(fit.transform, jnp.float32),
        improved=found.improved | fit.improved,
        converged=jnp.asarray(fit.converged),
        steps=found.steps + fit.steps,
        quality=dataclasses.replace(found.quality, **measured),
    )
    case.seconds["run"] += time.perf_counter() - began
    return dataclasses.replace(case, found=found)


def _used(unit: UnitCloud) -> HostSurface:
    normals = None if unit.normals is None else unit.normals[unit.mask].astype(np.float64)
    return HostSurface(unit.points[unit.mask].astype(np.float64), normals)


def _every(plan: Plan) -> tuple[HostSurface, HostSurface]:
    """All points of both clouds, where the unit clouds of the plan lie."""
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
