"""A pair on its way from the plan to the answer, with everything found so far."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from cfr_jax.alignment import confidence, quality
from cfr_jax.alignment.planning import Plan
from cfr_jax.geometry import units
from cfr_jax.networks.cfr.registration import Registration
from cfr_jax.refine.surfaces import HostSurface


@struct.dataclass
class Found:
    """The results that come back from the device. They have a batch axis after `vmap`, and are
    numpy arrays once they are on the host."""

    registration: Registration
    transform: Float[Array, "*batch 4 4"] | Float[np.ndarray, "*batch 4 4"]
    """Maps the source, as it was sent to the device, onto the target."""
    improved: Bool[Array, "*batch"] | Bool[np.ndarray, "*batch"]
    """Whether `transform` is a refined motion, or a start, that fits no worse than the network's
    last answer, and not that answer."""
    converged: Bool[Array, "*batch"] | Bool[np.ndarray, "*batch"]
    steps: Int[Array, "*batch"] | Int[np.ndarray, "*batch"]
    quality: quality.Quality
    clues: confidence.Clues


@dataclass(frozen=True, eq=False)
class Search:
    """The result of a search. Motions map source onto target; the one with the smallest misfit
    comes first."""

    unit_motions: Float[np.ndarray, "k 4 4"]
    """The motions of the plan's unit clouds."""
    motions: Float[np.ndarray, "k 4 4"]
    """The same motions, of the caller's clouds."""
    fits: Float[np.ndarray, " k"]
    """The `quality.mutual_fit` of each motion, on the points that the network sees."""
    frames: units.Frames
    starts: int
    """The number of starts that were tried."""
    nearby: bool = False
    """Whether only starts around the source's own position were tried."""


@dataclass(frozen=True, eq=False)
class Placed:
    """Both clouds on the host, in the unit sphere of `frames`, and their trees."""

    source: HostSurface
    target: HostSurface
    frames: units.Frames


@dataclass(frozen=True, eq=False)
class Case:
    """The state that the steps of `align` pass along: each step takes a case and returns one."""

    params: dict[str, Any]
    plan: Plan
    found: Found | None = None
    """The answer so far, for the plan's unit clouds."""
    searched: Search | None = None
    """The last search for a better start, if there was one."""
    placed: Placed | None = None
    """All points of the clouds, or only those that the network saw if the plan has no others. None
    until a step needs them. They stay the same if the network starts from another position."""
    seconds: dict[str, float] = field(default_factory=lambda: {"compile": 0.0, "run": 0.0})
    """The time that all steps took together. Each step adds its own."""

    def solved(self) -> Found:
        """The answer so far. The network must have run before."""
        assert self.found is not None, "the network comes first"
        return self.found
