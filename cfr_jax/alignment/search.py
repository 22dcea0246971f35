"""Registration from anywhere: tries many starts on coarse clouds, refines the best on full ones.

The network finds rotations of up to about 45 degrees about each axis. So it is started from
rotations that cover all of SO(3), on clouds that are thinned until all starts together cost little.
The results are ranked by how well the clouds then fit, never by the network itself.
"""

from __future__ import annotations

import dataclasses
import functools
import time

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Float

from cfr_jax.alignment import planning, quality, refining
from cfr_jax.alignment.case import Case, Search
from cfr_jax.alignment.solving import DeviceCloud, on_accelerator, on_device, surface, timed
from cfr_jax.geometry import rigid, units
from cfr_jax.geometry.motions import angle_between
from cfr_jax.networks.cfr.registration import encode, register
from cfr_jax.networks.inputs import Settings, moved_by
from cfr_jax.networks.record import Params
from cfr_jax.refine import generalized_icp
from cfr_jax.runtime import programs

COARSE = Settings(neighbors=24)
COARSE_POINTS = 256
KEPT = 4
_AT_ONCE = 32  # starts that accelerators vectorize together; one at a time fits a CPU's caches
# Two answers closer than this count as one, because refinement takes both to the same place.
_SAME_TURN = 20.0  # degrees
_SAME_PLACE = 0.2  # units of the unit sphere
RIVAL = 0.95  # share of the best fit from which on the shapes alone do not say which one is right
_FEW = 8  # up to this many given starts are all refined on the full clouds, too
_COARSE_REACH = 0.1
_FULL_REACH = generalized_icp.CUT


@struct.dataclass
class Candidates:
    """Motions of the source onto the target, and how well each one fits."""

    motions: Float[Array, "k 4 4"]
    fits: Float[Array, " k"]


programs.storable(Candidates)


@functools.partial(jax.jit, static_argnames=("kept", "at_once", "as_given"))
def propose(
    params: Params,
    source: DeviceCloud,
    target: DeviceCloud,
    starts: Float[Array, "s 4 4"],
    *,
    kept: int = KEPT,
    at_once: int = 1,
    as_given: bool = False,
) -> Candidates:
    """Runs the network from each start on coarse clouds, and returns the `kept` best motions that
    differ from each other.

    `at_once` starts go through the network together (`vmap`); the target is encoded once. With
    `as_given`, each start is also refined without the network. If fewer than `kept` motions differ,
    the remaining rows have a fit of -1.
    """
    sides = source.prepared(COARSE), target.prepared(COARSE)
    encoded = encode(params, sides[1], settings=COARSE)
    surfaces = surface(sides[0]), surface(sides[1])

    def end(start: Array) -> tuple[Array, Array]:
        found = register(params, moved_by(start, sides[0]), encoded, settings=COARSE)
        ends = [rigid.compose(found.transform, start)]
        if as_given:
            ends.append(jnp.asarray(generalized_icp.refine(*surfaces, start).transform))
        fits = [quality.mutual_fit(*surfaces, motion, _COARSE_REACH) for motion in ends]
        return jnp.stack(ends), jnp.stack(fits)

    motions, fits = lax.map(end, starts, batch_size=at_once if at_once > 1 else None)
    return _distinct(motions.reshape(-1, 4, 4), fits.ravel(), kept)


@jax.jit
def polish(source: DeviceCloud, target: DeviceCloud, found: Float[Array, "k 4 4"]) -> Candidates:
    """Refines each motion on the full clouds, and measures how well it then fits."""
    first, second = (surface(cloud.prepared(planning.SETTINGS)) for cloud in (source, target))

    def refine(motion: Array) -> tuple[Array, Array]:
        refined = jnp.asarray(generalized_icp.refine(first, second, motion).transform)
        return refined, quality.mutual_fit(first, second, refined, _FULL_REACH)

    return Candidates(*lax.map(refine, found))


def search(case: Case) -> Case:
    """Tries all starts of the plan, and moves the source to the one that fits best."""
    assert case.plan.starts is not None
    starts = case.plan.starts
    few = starts if len(starts) <= _FEW else None
    return started(tried(case, starts, beside=few, as_given=True))


def started(case: Case) -> Case:
    """The case with its source moved by the best motion that `tried` found."""
    assert case.searched is not None
    plan = case.plan.started_at(case.searched.unit_motions[0])
    return dataclasses.replace(case, plan=plan)


def tried(
    case: Case,
    starts: Float[np.ndarray, "s 4 4"],
    *,
    beside: Float[np.ndarray, "b 4 4"] | None = None,
    nearby: bool = False,
    as_given: bool = False,
) -> Case:
    """The case with the result of a search in `searched`: the best motions of its source onto its
    target, found from all `starts`, which are motions between the unit clouds.

    The motions in `beside` are refined as well, but without the network. With `as_given`, the
    starts are also refined without the network. The motions are ranked by their misfit on all
    points (`measuring.misfit`). `nearby` says that all starts lie around the source's own position.
    """
    plan = case.plan
    at_once = _AT_ONCE if on_accelerator() else 1
    coarse = on_device(
        *(
            units.thinned(
                unit,
                budget=COARSE_POINTS,
                neighbors=COARSE.neighbors,
                radius=COARSE.radius,
                seed=plan.seed,
            )
            for unit in (plan.source, plan.target)
        )
    )
    arguments = (case.params, *coarse, jnp.asarray(starts, jnp.float32))
    proposed = timed(case.seconds, propose, *arguments, at_once=at_once, as_given=as_given)
    motions = np.asarray(proposed.motions)
    if beside is not None:
        motions = np.concatenate([motions, beside.astype(np.float32)])
    whole = on_device(plan.source, plan.target)
    found = timed(case.seconds, polish, *whole, jnp.asarray(motions))
    began = time.perf_counter()
    unit_motions = np.asarray(found.motions, np.float64)
    case = refining.placed(case)
    misfits = [refining.misfit(case, motion) for motion in unit_motions]
    order: list[int] = []
    for row in np.argsort(misfits, kind="stable"):
        if not any(_near(unit_motions[row], unit_motions[kept]) for kept in order):
            order.append(row)
    case.seconds["run"] += time.perf_counter() - began
    searched = Search(
        unit_motions=unit_motions[order],
        motions=plan.frames.to_caller(unit_motions[order]),
        fits=np.asarray(found.fits, np.float64)[order],
        frames=plan.frames,
        starts=len(starts),
        nearby=nearby,
    )
    return dataclasses.replace(case, searched=searched)


def rivals(searched: Search, transform: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "a 4 4"]:
    """The motions that differ from `transform` and fit about as well as the best one."""
    frames, fits = searched.frames, searched.fits
    unit, mine = frames.to_unit(searched.motions), frames.to_unit(transform)
    near = np.array([_near(mine, other) for other in unit])
    return searched.motions[(fits >= RIVAL * fits.max()) & ~near]


def same(first: Float[Array, "4 4"], second: Float[Array, "4 4"]) -> Array:
    """Whether two motions of unit clouds are too close to count as different answers."""
    away = jnp.linalg.norm(first[:3, 3] - second[:3, 3])
    return (rigid.rotation_error(first, second) < _SAME_TURN) & (away < _SAME_PLACE)


def _near(first: np.ndarray, second: np.ndarray) -> bool:
    """Does what `same` does, on the host."""
    away = np.linalg.norm(first[:3, 3] - second[:3, 3])
    return bool(angle_between(first, second) < _SAME_TURN and away < _SAME_PLACE)


def _distinct(motions: Array, fits: Array, kept: int) -> Candidates:
    """The `kept` best motions that differ: the best fit, then the best of those that differ from
    it, and so on."""

    def take(fits: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
        best = jnp.argmax(fits)
        near = jax.vmap(functools.partial(same, motions[best]))(motions)
        return jnp.where(near, -1, fits), (motions[best], fits[best])

    return Candidates(*lax.scan(take, fits, length=kept)[1])
