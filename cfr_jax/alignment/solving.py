"""What `align` runs on the device: the network, the refinement, and what their answer is worth.

Pure functions of one pair of unit clouds; batches are `vmap`.
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
    """A unit cloud on the device, with neighbors, and with normals if the caller gave some."""

    points: Float[Array, "*batch n c"]
    neighbors: Int[Array, "*batch n k"] | None
    """None where the device is to find them."""
    mask: Bool[Array, "*batch n"]

    def prepared(self, settings: Settings = SETTINGS) -> Cloud:
        """As the network takes it."""
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
    """The device's part for one pair of unit clouds: registered, refined, judged.

    Refining never answers worse, by its own score, than the network did or than the source lay
    when it came: a start that fits better than all that was found from it stands.
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
    """`found` with another refinement's `transform` instead, unless that fits worse."""
    cloud = target.prepared()
    surfaces = surface(source.prepared()), surface(cloud)
    before, after = scores(*surfaces, jnp.stack([found.transform, transform]), DISTANCE)
    improved = after <= before
    transform = jnp.where(improved, transform, found.transform)
    measured, clues = _judge(found.registration, transform, cloud, surfaces)
    return Found(found.registration, transform, improved, converged, steps, measured, clues)


@jax.jit
def judged(source: DeviceCloud, target: DeviceCloud, found: Found) -> Found:
    """`found` with the quality and the clues of its transform, which somebody put there."""
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
    """A prepared cloud as the refinement sees it."""
    mask = jnp.ones(cloud.points.shape[0], bool) if cloud.mask is None else cloud.mask
    return Surface(cloud.points, cloud.normals, mask)


def on_accelerator() -> bool:
    """Whether programs run on anything but a CPU."""
    return jax.default_backend() != "cpu"


def on_device(*clouds: UnitCloud) -> tuple[DeviceCloud, ...]:
    """Unit clouds, all sent to the device at once."""
    rows = [
        unit.points if unit.normals is None else np.hstack([unit.points, unit.normals])
        for unit in clouds
    ]
    # not jnp.asarray, which compiles a copy of each shape
    sent = jax.device_put([(r, c.neighbors, c.mask) for r, c in zip(rows, clouds, strict=True)])
    return tuple(DeviceCloud(*parts) for parts in sent)


@functools.partial(jax.jit, static_argnames=("refine",))
def solve_pair(
    params: Params, source: DeviceCloud, target: DeviceCloud, *, refine: Refinement | None
) -> Found:
    """`solve` for two clouds as `on_device` hands them over."""
    encoded = encode(params, target.prepared(), settings=SETTINGS)
    return solve(params, source.prepared(), encoded, refine=refine)


def solve_case(case: Case, *, refine: Refinement | None) -> Case:
    """The case with what the network finds for its plan, refined by what JAX can trace.

    What is found comes back to the host in one transfer: on an accelerator each costs as much as
    a few kernels.
    """
    sides = on_device(case.plan.source, case.plan.target)
    found = timed(case.seconds, solve_pair, case.params, *sides, refine=refine)
    return dataclasses.replace(case, found=jax.device_get(found))


def timed(seconds: dict[str, float], function: Callable, *arguments: Any, **static: Any) -> Any:
    """What a jitted function answers, when it is there; adds the time to the `seconds` of "compile"
    and of "run"."""
    began = time.perf_counter()
    program = programs.compiled(function, *arguments, **static)
    ready = time.perf_counter()
    answer = jax.block_until_ready(program(*arguments))
    seconds["compile"] += ready - began
    seconds["run"] += time.perf_counter() - ready
    return answer
