"""Registration from anywhere: many starts on coarse clouds, the best few refined on full ones.

The network finds motions of up to about 45 degrees about each axis. So it is started from rotations
that cover all of SO(3), on clouds thinned so far that all starts together cost little; where each
of them ended is told by how well the clouds then lie on each other, never by the network itself.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Float

from cfr_jax import planning, preparation, programs, quality, refinement, rigid
from cfr_jax.io import PointCloud
from cfr_jax.prepared import Settings, moved_by, prepare
from cfr_jax.registration import encode, register
from cfr_jax.rotations import cover
from cfr_jax.solving import on_device, surface, timed

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
_FULL_REACH = refinement.CUT


@dataclass(frozen=True, eq=False)
class Search:
    """What was found, in the caller's frame; motions map source onto target, the best first."""

    motions: Float[np.ndarray, "k 4 4"]
    fits: Float[np.ndarray, " k"]
    """`quality.mutual_fit` of each, on the full clouds; never rising."""
    frames: preparation.Frames
    starts: int
    """How many were tried."""

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
        refined = refinement.refine(*surfaces, motion).transform
        return refined, quality.mutual_fit(*surfaces, refined, _FULL_REACH)

    return _distinct(*lax.map(refine, motions), len(motions))


def search(
    params: dict,
    source: PointCloud,
    target: PointCloud,
    starts: Float[np.ndarray, "s 4 4"] | None = None,
    *,
    max_points: int | None = None,
    seed: int = 0,
    seconds: dict[str, float],
) -> Search:
    """The best motions of `source` onto `target` from all `starts`, on the host.

    Starts are motions in the caller's frame; None stands for the cover of all rotations, centroid
    on centroid. Adds its time to `seconds`, as `solving.timed` does. Raises ValueError as `align`
    does.
    """
    plan = planning.planned(source, target, max_points=max_points, seed=seed)
    frames = plan.frames
    if starts is None:
        unit_starts = np.tile(np.eye(4), (STARTS, 1, 1))
        unit_starts[:, :3, :3] = cover(STARTS)
    else:
        unit_starts = frames.to_unit(starts)
        away = np.abs(unit_starts[:, :3, 3]).max(axis=1)
        if away.max() > preparation.FARTHEST:
            raise ValueError(
                f"initial: number {away.argmax()} leaves the source {away.max():.3g} radii away "
                f"from the target, wanted at most {preparation.FARTHEST:g}"
            )
    coarse = planning.planned(source, target, max_points=COARSE_POINTS, seed=seed, settings=COARSE)
    at_once = 1 if jax.default_backend() == "cpu" else _AT_ONCE
    thinned = on_device(coarse.source), on_device(coarse.target)
    arguments = (params, *thinned, jnp.asarray(unit_starts, jnp.float32))
    proposed = timed(seconds, propose, *arguments, at_once=at_once)
    whole = on_device(plan.source), on_device(plan.target)
    found = timed(seconds, polish, *whole, proposed.motions)
    real = np.asarray(found.fits) >= 0
    return Search(
        motions=frames.to_caller(np.asarray(found.motions)[real]),
        fits=np.asarray(found.fits, np.float64)[real],
        frames=frames,
        starts=len(unit_starts),
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
