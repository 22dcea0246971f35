"""`align`: two clouds of one thing, any size, units and offset, and the motion between them."""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Integral
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from cfr_jax import confidence, preparation, quality, refinement
from cfr_jax.io import as_point_cloud
from cfr_jax.registration import Registration, Settings, prepare, register
from cfr_jax.weights import load_params

DEFAULT_BUDGET = 1024
_SETTINGS = Settings()
_DISTANCE = refinement.CUT
# Below this the fit hardly suffers when a cloud slides or turns. Of planes, spheres, cylinders,
# cones and the like, sampled twice by 200 to 500 points with noise, 97% measured less along their
# free directions; of partial views of real objects about three quarters measured more.
_FREE = 0.08
_TRUSTED = 0.5
_HARDLY = 0.2  # of the source on the target: too little to say what the shapes determine
_SIZES_APART = 5.0  # more than partial views of one thing differ in radius


@dataclass(frozen=True)
class Alignment:
    """Answer of `align`; everything in the caller's frame and units."""

    transform: Float[np.ndarray, "4 4"]
    """Maps source onto target: `transform @ [x; 1]` lies on the target. Float64."""
    transforms: Float[np.ndarray, "L 4 4"]
    """What the network answered, one per iteration, before any refinement."""
    refined: bool
    """Whether `transform` is the refinement's answer, and not the network's last."""
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

    @property
    def trusted(self) -> bool:
        """Whether the motion is determined and more likely right than wrong."""
        return self.determined and self.confidence >= _TRUSTED


def align(
    source: Any,
    target: Any,
    *,
    params: dict | None = None,
    refine: bool = True,
    initial: Float[np.ndarray, "4 4"] | None = None,
    max_points: int | None = None,
    seed: int = 0,
) -> Alignment:
    """Finds the rigid motion that lays `source` on `target`.

    Clouds are (n, 3) arrays, (n, 6) with normals, paths, or Open3D and trimesh objects. They are
    centered and scaled in float64, thinned to `max_points` each (default 1,024; `seed` says which),
    given normals where they have none, registered by the network with `params` (default: the
    weights that ship) and refined (`refinement.refine`; off with `refine=False`).

    `initial` (4, 4) moves the source close to the target first; without it the centroids are laid
    on each other. The network is trained for up to 45 degrees about each axis from there. The same
    call gives the same answer, to the bit, on the same machine.

    Raises ValueError for clouds without extent or with fewer than 3 points, wrong shapes, values
    that are not finite, and an `initial` that is no rigid motion or leaves the clouds far apart;
    `io.CloudFileError` for files.
    """
    began = time.perf_counter()
    clouds = [
        as_point_cloud(cloud, name=name) for cloud, name in ((source, "source"), (target, "target"))
    ]
    for cloud, name in zip(clouds, ("source", "target"), strict=True):
        if len(cloud.points) < 3:
            raise ValueError(f"{name}: got {len(cloud.points)} points, wanted at least 3")
    if initial is not None:
        initial = _rigid(initial)
    budget = DEFAULT_BUDGET if max_points is None else _whole("max_points", max_points, least=3)
    seed = _whole("seed", seed, least=0)
    params = _default_params() if params is None else params
    if not isinstance(params, Mapping):
        raise ValueError(
            f"params: got a {type(params).__name__}, wanted the parameters of load_params"
        )

    frames = preparation.unit_frames(*clouds, initial)
    unit_source, unit_target = (
        preparation.to_unit(
            cloud,
            center,
            frames.scale,
            motion,
            budget=budget,
            neighbors=_SETTINGS.neighbors,
            radius=_SETTINGS.radius,
            seed=seed,
        )
        for cloud, center, motion in (
            (clouds[0], frames.source_center, frames.initial),
            (clouds[1], frames.target_center, np.eye(4)),
        )
    )
    arguments = (params, _on_device(unit_source), _on_device(unit_target))
    started = time.perf_counter()
    program = _program(refine, *_signature(arguments))
    compiled = time.perf_counter()
    found = jax.block_until_ready(program(*arguments))
    done = time.perf_counter()

    resistance = np.asarray(found.quality.resistance)
    determined = bool(resistance.min() >= _FREE)
    weakest = np.asarray(found.quality.weakest)[resistance.argmin()]
    fitness = float(found.quality.fitness)
    clues = {name: float(value) for name, value in vars(found.clues).items()}
    probability = confidence.of_alignment(clues)
    neighbors = min(unit_source.neighbors.shape[1], unit_target.neighbors.shape[1])
    return Alignment(
        transform=frames.to_caller(np.asarray(found.transform)),
        transforms=frames.to_caller(np.asarray(found.registration.transforms)),
        refined=refine and bool(found.improved),
        confidence=probability,
        clues=clues,
        determined=determined,
        fitness=fitness,
        inlier_rmse=float(found.quality.inlier_rmse) * frames.scale,
        inlier_distance=_DISTANCE * frames.scale,
        weights=np.asarray(found.registration.weights, np.float64)[: len(unit_source.rows)],
        source_rows=unit_source.rows,
        target_rows=unit_target.rows,
        neighbors=neighbors,
        warnings=_warnings(
            None if determined else weakest, probability, fitness, neighbors, frames.size_ratio
        ),
        seconds={
            "compile": compiled - started,
            "run": done - compiled,
            "total": time.perf_counter() - began,
        },
    )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Found:
    """What comes back from the device."""

    registration: Registration
    transform: Float[jax.Array, "4 4"]
    improved: Bool[jax.Array, ""]
    quality: quality.Quality
    clues: confidence.Clues


@functools.partial(jax.jit, static_argnames=("refine",))
def _solve(params, source, target, *, refine):
    source, target = (prepare(**cloud, settings=_SETTINGS) for cloud in (source, target))
    registration = register(params, source, target, settings=_SETTINGS)
    surfaces = [
        refinement.Surface(cloud.points, cloud.normals, cloud.mask) for cloud in (source, target)
    ]
    transform, improved = registration.transform, jnp.array(False)
    if refine:
        refined = refinement.refine(*surfaces, transform)
        transform, improved = refined.transform, refined.improved
    measured = quality.measure(*surfaces, transform, _DISTANCE)
    clues = confidence.gather(registration, *surfaces, transform, measured)
    return _Found(registration, transform, improved, measured, clues)


def _on_device(unit):
    points = unit.points if unit.normals is None else np.hstack([unit.points, unit.normals])
    return {
        "points": jnp.asarray(points),
        "neighbors": jnp.asarray(unit.neighbors),
        "mask": jnp.asarray(unit.mask),
    }


def _signature(arguments):
    leaves, structure = jax.tree.flatten(arguments)
    return structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves)


@functools.lru_cache(maxsize=64)
def _program(refine, structure, shapes):
    """The compiled program for clouds of these sizes, so that compiling can be timed apart."""
    arguments = jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(*shape) for shape in shapes])
    return _solve.lower(*arguments, refine=refine).compile()


@functools.cache
def _default_params():
    return load_params()


def _whole(name, value, *, least):
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        raise ValueError(f"{name}: got {value!r}, wanted a whole number of at least {least}")
    return int(value)


def _rigid(initial):
    try:
        matrix = np.asarray(initial, np.float64)
    except (TypeError, ValueError):
        raise ValueError(
            f"initial: got a {type(initial).__name__} that is no array of numbers, "
            "wanted a (4, 4) matrix"
        ) from None
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError(f"initial: got shape {matrix.shape}, wanted a finite (4, 4) matrix")
    rotation = matrix[:3, :3]
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if off > 1e-3 or np.linalg.det(rotation) < 0 or np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise ValueError(
            "initial: got a matrix that is no rigid motion, wanted a proper rotation "
            "and a last row 0 0 0 1"
        )
    return matrix


def _warnings(free, probability, fitness, neighbors, size_ratio):
    warnings = []
    if not 1 / _SIZES_APART < size_ratio < _SIZES_APART:
        larger, smaller, times = "source", "target", size_ratio
        if size_ratio < 1:
            larger, smaller, times = "target", "source", 1 / size_ratio
        warnings.append(f"the {larger} is {times:.3g} times as large as the {smaller}: same units?")
    if fitness < _HARDLY:
        warnings.append(f"the clouds hardly meet: {fitness:.0%} of the source lies on the target")
    elif free is not None:
        warnings.append(f"the clouds do not determine the motion: they {_describe(free)} freely")
    if probability < _TRUSTED:
        warnings.append(
            f"not to be trusted: confidence {probability:.2f}, "
            f"{fitness:.0%} of the source lies on the target"
        )
    if neighbors < _SETTINGS.neighbors:
        warnings.append(
            f"small clouds: {neighbors} neighbors per point instead of {_SETTINGS.neighbors}"
        )
    return tuple(warnings)


def _describe(twist):
    turn, slide = twist[:3], twist[3:]
    verb, axis = (
        ("turn about", turn)
        if np.linalg.norm(turn) >= np.linalg.norm(slide)
        else ("slide along", slide)
    )
    axis = axis / np.linalg.norm(axis)
    axis = axis * np.sign(axis[np.abs(axis).argmax()])
    axis = axis.round(2) + 0.0  # no "-0.00"
    return f"{verb} ({', '.join(f'{value:.2f}' for value in axis)})"
