"""Registration from anywhere: many starts on coarse clouds, the best few refined on full ones.

The network finds motions of up to about 45 degrees about each axis. So it is started from rotations
that cover all of SO(3), on clouds thinned so far that all starts together cost little; where each
of them ended is told by how well the clouds then lie on each other, never by the network itself.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Float

from cfr_jax.alignment import planning, quality
from cfr_jax.alignment.solving import on_device, surface, timed
from cfr_jax.geometry import motions, rigid, units
from cfr_jax.networks.cfr.registration import encode, register
from cfr_jax.networks.inputs import Settings, moved_by, prepare
from cfr_jax.refine import generalized_icp
from cfr_jax.runtime import programs

STARTS = 128  # no rotation is farther than 46 degrees from one of them, and most within 24
COARSE = Settings(neighbors=24)
COARSE_POINTS = 256
KEPT = 4
_AT_ONCE = 32  # starts vectorized together by accelerators; one by one they stay in a CPU's caches
# Two answers closer than this are one: they end in one place when refined.
_SAME_TURN = 20.0  # degrees
_SAME_PLACE = 0.2
RIVAL = 0.95  # of the best fit: so near, the shapes alone do not say which is right
_COARSE_REACH = 0.1
_FULL_REACH = generalized_icp.CUT


@dataclass(frozen=True, eq=False)
class Search:
    """What was found; motions map source onto target, the best first."""

    unit_motions: Float[np.ndarray, "k 4 4"]
    """Of the unit clouds of the plan."""
    motions: Float[np.ndarray, "k 4 4"]
    """Of the caller's clouds."""
    fits: Float[np.ndarray, " k"]
    """`quality.mutual_fit` of each, on the full clouds; never rising."""
    frames: units.Frames
    starts: int
    """How many were tried."""
    nearby: bool = False
    """Whether only starts around where the source lay were."""

    def rivals(self, transform: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "a 4 4"]:
        """Motions that differ from `transform` and fit about as well as the best."""
        unit, mine = self.frames.to_unit(self.motions), self.frames.to_unit(transform)
        near = np.array([bool(same(*jnp.array([mine, other], jnp.float32))) for other in unit])
        return self.motions[(self.fits >= RIVAL * self.fits[0]) & ~near]


@struct.dataclass
class Candidates:
    """Motions of the source onto the target, the best first, and how well each fits."""

    motions: Float[Array, "k 4 4"]
    fits: Float[Array, " k"]


programs.storable(Candidates)


@functools.partial(jax.jit, static_argnames=("kept", "at_once"))
def propose(
    params: dict,
    source: dict[str, Array],
    target: dict[str, Array],
    starts: Float[Array, "s 4 4"],
    *,
    kept: int = KEPT,
    at_once: int = 1,
) -> Candidates:
    """Where the network ends on coarse clouds from each start: the `kept` that fit best and differ.

    `at_once` starts go through the network together (`vmap`); the target is encoded once. Where
    fewer than `kept` differ, the rest have a fit of -1.
    """
    source, target = (prepare(**cloud, settings=COARSE) for cloud in (source, target))
    encoded = encode(params, target, settings=COARSE)
    surfaces = surface(source), surface(target)

    def end(start):
        found = register(params, moved_by(start, source), encoded, settings=COARSE)
        motion = rigid.compose(found.transform, start)
        return motion, quality.mutual_fit(*surfaces, motion, _COARSE_REACH)

    motions, fits = lax.map(end, starts, batch_size=at_once if at_once > 1 else None)
    return _distinct(motions, fits, kept)


@jax.jit
def polish(source: dict[str, Array], target: dict[str, Array], motions: Array) -> Candidates:
    """Refines each motion on the full clouds, and puts what fits best first."""
    surfaces = [surface(prepare(**cloud, settings=planning.SETTINGS)) for cloud in (source, target)]

    def refine(motion):
        refined = generalized_icp.refine(*surfaces, motion).transform
        return refined, quality.mutual_fit(*surfaces, refined, _FULL_REACH)

    return _distinct(*lax.map(refine, motions), len(motions))


def everywhere() -> Float[np.ndarray, "s 4 4"]:
    """Starts of unit clouds that cover all rotations, centroid on centroid."""
    return motions.motion(motions.cover(STARTS))


def around() -> Float[np.ndarray, "s 4 4"]:
    """Starts of unit clouds around the one where they lie, for a second look: that one, and turns
    about six axes by 40 and about the eight between them by 50 degrees."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    between = np.array(list(itertools.product((1, -1), repeat=3))) / np.sqrt(3)
    turns = np.concatenate([np.zeros((1, 3)), 40 * axes, 50 * between])
    return motions.motion(motions.from_rotvec(np.radians(turns)))


def given(frames: units.Frames, starts: Float[np.ndarray, "s 4 4"]) -> Float[np.ndarray, "s 4 4"]:
    """Starts of the caller's clouds as those of unit clouds. Raises ValueError as `align` does."""
    unit_starts = frames.to_unit(starts)
    away = np.abs(unit_starts[:, :3, 3]).max(axis=1)
    if away.max() > units.FARTHEST:
        raise ValueError(
            f"initial: number {away.argmax()} leaves the source {away.max():.3g} radii away "
            f"from the target, wanted at most {units.FARTHEST:g}"
        )
    return unit_starts


def search(
    params: dict,
    plan: planning.Plan,
    starts: Float[np.ndarray, "s 4 4"],
    *,
    seconds: dict[str, float],
) -> Search:
    """The best motions of the plan's source onto its target from all `starts` of unit clouds.

    Adds its time to `seconds`, as `solving.timed` does.
    """
    at_once = 1 if jax.default_backend() == "cpu" else _AT_ONCE
    coarse = (
        units.thinned(
            unit,
            budget=COARSE_POINTS,
            neighbors=COARSE.neighbors,
            radius=COARSE.radius,
            seed=plan.seed,
        )
        for unit in (plan.source, plan.target)
    )
    arguments = (params, *map(on_device, coarse), jnp.asarray(starts, jnp.float32))
    proposed = timed(seconds, propose, *arguments, at_once=at_once)
    whole = on_device(plan.source), on_device(plan.target)
    found = timed(seconds, polish, *whole, proposed.motions)
    real = np.asarray(found.fits) >= 0
    unit_motions = np.asarray(found.motions, np.float64)[real]
    return Search(
        unit_motions=unit_motions,
        motions=plan.frames.to_caller(unit_motions),
        fits=np.asarray(found.fits, np.float64)[real],
        frames=plan.frames,
        starts=len(starts),
    )


def same(first: Float[Array, "4 4"], second: Float[Array, "4 4"]) -> Array:
    """Whether two motions of unit clouds are too close to count as different answers."""
    away = jnp.linalg.norm(first[:3, 3] - second[:3, 3])
    return (rigid.rotation_error(first, second) < _SAME_TURN) & (away < _SAME_PLACE)


def _distinct(motions, fits, kept):
    """The best fit, then the best of those that differ from it, and so on."""

    def take(fits, _):
        best = jnp.argmax(fits)
        near = jax.vmap(functools.partial(same, motions[best]))(motions)
        return jnp.where(near, -1, fits), (motions[best], fits[best])

    return Candidates(*lax.scan(take, fits, length=kept)[1])
