"""The part of `align` that runs on the device: the network, the refinement, and the quality.

The numerical functions are pure and take one pair of unit clouds. Batches use `vmap`.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from cfr_jax.alignment import confidence, quality
from cfr_jax.alignment.case import Case, Found
from cfr_jax.alignment.planning import CASCADES, SETTINGS
from cfr_jax.geometry.units import UnitCloud
from cfr_jax.networks.cfr.iterations import Encoded
from cfr_jax.networks.cfr.registration import Registration, encode, register
from cfr_jax.networks.clues import NetworkClues
from cfr_jax.networks.inputs import Cloud, Settings, prepare
from cfr_jax.networks.probability import Calibration
from cfr_jax.networks.record import Params
from cfr_jax.refine import Refinement, generalized_icp
from cfr_jax.refine.generalized_icp import scores
from cfr_jax.refine.surfaces import Surface
from cfr_jax.runtime import programs

DISTANCE = generalized_icp.CUT


@struct.dataclass
class DeviceCloud:
    """A unit cloud on the device."""

    points: Float[Array, "*batch n c"]
    """Points, followed by normals in the last three columns if the caller gave some."""
    neighbors: Int[Array, "*batch n k"] | None
    """The rows of each point's neighbors; None if the device has to find them."""
    mask: Bool[Array, "*batch n"]

    def prepared(self, settings: Settings = SETTINGS) -> Cloud:
        """The cloud in the form that the network takes."""
        return prepare(self.points, neighbors=self.neighbors, mask=self.mask, settings=settings)


programs.storable(
    DeviceCloud,
    Cloud,
    Encoded,
    Registration,
    Found,
    quality.Quality,
    confidence.Clues,
    NetworkClues,
)
programs.storable_static(Calibration, Calibration.write, Calibration.read)


def solve(params: Params, source: Cloud, target: Encoded, *, refine: Refinement | None) -> Found:
    """Registers and refines one pair of unit clouds and measures the quality of the answer.

    With `refine`, the answer never scores worse, by the refinement's own score, than the network's
    answer or than the source's original position. If that position fits better than everything
    found from it, it is the answer.
    """
    registration = register(params, source, target, cascades=CASCADES, settings=SETTINGS)
    surfaces = surface(source), surface(target.cloud)
    transform = registration.transform
    improved = converged = jnp.array(False)
    steps = jnp.zeros((), jnp.int32)
    if refine is not None:
        refined = refine(*surfaces, transform)
        start = jnp.eye(4, dtype=transform.dtype)
        kept, moved = scores(*surfaces, jnp.stack([start, refined.transform]), DISTANCE)
        stays = kept < moved
        transform = jnp.where(stays, start, refined.transform)
        improved, steps = refined.improved | stays, jnp.asarray(refined.steps)
        converged = jnp.asarray(refined.converged)
    measured, clues = _judge(registration, transform, target.cloud, surfaces)
    return Found(registration, transform, improved, converged, steps, measured, clues)


@jax.jit
def replaced(
    source: DeviceCloud,
    target: DeviceCloud,
    found: Found,
    transform: Float[Array, "4 4"],
    converged: Bool[Array, ""],
    steps: Int[Array, ""],
) -> Found:
    """Replaces the motion in `found` with the `transform` of another refinement, unless that fits
    worse."""
    cloud = target.prepared()
    surfaces = surface(source.prepared()), surface(cloud)
    before, after = scores(*surfaces, jnp.stack([found.transform, transform]), DISTANCE)
    improved = after <= before
    transform = jnp.where(improved, transform, found.transform)
    measured, clues = _judge(found.registration, transform, cloud, surfaces)
    return Found(found.registration, transform, improved, converged, steps, measured, clues)


@jax.jit
def judged(source: DeviceCloud, target: DeviceCloud, found: Found) -> Found:
    """Measures the quality and the clues in `found` again, for a transform that was replaced."""
    cloud = target.prepared()
    surfaces = surface(source.prepared()), surface(cloud)
    measured, clues = _judge(found.registration, jnp.asarray(found.transform), cloud, surfaces)
    return dataclasses.replace(found, quality=measured, clues=clues)


def _judge(
    registration: Registration, transform: Array, target: Cloud, surfaces: tuple[Surface, Surface]
) -> tuple[quality.Quality, confidence.Clues]:
    spacing = quality.spacing(target.points, target.neighbors, surfaces[1].mask)
    measured = quality.measure(*surfaces, transform, DISTANCE, spacing)
    return measured, confidence.gather(
        registration.clues, registration.transform, transform, measured
    )


def surface(cloud: Cloud) -> Surface:
    """The surface that a refinement gets for a prepared cloud."""
    mask = jnp.ones(cloud.points.shape[0], bool) if cloud.mask is None else cloud.mask
    return Surface(cloud.points, cloud.normals, mask)


def on_accelerator() -> bool:
    """Whether programs run on something other than a CPU."""
    return jax.default_backend() != "cpu"


def on_device(*clouds: UnitCloud) -> tuple[DeviceCloud, ...]:
    """Sends unit clouds to the device, all in one transfer."""
    rows = [
        unit.points if unit.normals is None else np.hstack([unit.points, unit.normals])
        for unit in clouds
    ]
    # jnp.asarray would compile a copy program for each shape
    sent = jax.device_put([(r, c.neighbors, c.mask) for r, c in zip(rows, clouds, strict=True)])
    return tuple(DeviceCloud(*parts) for parts in sent)


@functools.partial(jax.jit, static_argnames=("refine",))
def solve_pair(
    params: Params, source: DeviceCloud, target: DeviceCloud, *, refine: Refinement | None
) -> Found:
    """Runs `solve` on two clouds that `on_device` returned."""
    encoded = encode(params, target.prepared(), settings=SETTINGS)
    return solve(params, source.prepared(), encoded, refine=refine)


def solve_case(case: Case, *, refine: Refinement | None) -> Case:
    """The case with the network's answer for its plan, after the refinement that JAX can trace.

    The results come back to the host in one transfer, because on an accelerator each transfer costs
    as much as a few kernels.
    """
    sides = on_device(case.plan.source, case.plan.target)
    found = timed(case.seconds, solve_pair, case.params, *sides, refine=refine)
    return dataclasses.replace(case, found=jax.device_get(found))


def timed(seconds: dict[str, float], function: Callable, *arguments: Any, **static: Any) -> Any:
    """Calls a jitted function, waits for its result and returns it. Adds the time to "compile" and
    "run" in `seconds`."""
    began = time.perf_counter()
    program = programs.compiled(function, *arguments, **static)
    ready = time.perf_counter()
    answer = jax.block_until_ready(program(*arguments))
    seconds["compile"] += ready - began
    seconds["run"] += time.perf_counter() - ready
    return answer
