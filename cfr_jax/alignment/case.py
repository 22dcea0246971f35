"""A pair on its way from the plan to the answer, and what is known of it by then."""

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
    """What comes back from the device; batched after `vmap`. Arrays of numpy on the host."""

    registration: Registration
    transform: Float[Array, "*batch 4 4"] | Float[np.ndarray, "*batch 4 4"]
    """Maps the source, as it was handed over, onto the target."""
    improved: Bool[Array, "*batch"] | Bool[np.ndarray, "*batch"]
    """Whether `transform` is not the network's last, but one that fits no worse."""
    converged: Bool[Array, "*batch"] | Bool[np.ndarray, "*batch"]
    steps: Int[Array, "*batch"] | Int[np.ndarray, "*batch"]
    quality: quality.Quality
    clues: confidence.Clues


@dataclass(frozen=True, eq=False)
class Search:
    """What a search found; motions map source onto target, the one with the least misfit first."""

    unit_motions: Float[np.ndarray, "k 4 4"]
    """Of the unit clouds of the plan."""
    motions: Float[np.ndarray, "k 4 4"]
    """Of the caller's clouds."""
    fits: Float[np.ndarray, " k"]
    """`quality.mutual_fit` of each, on the points that the network sees."""
    frames: units.Frames
    starts: int
    """How many were tried."""
    nearby: bool = False
    """Whether only starts around where the source lay were."""


@dataclass(frozen=True, eq=False)
class Placed:
    """Both clouds on the host, in the unit sphere of `frames`, and their trees."""

    source: HostSurface
    target: HostSurface
    frames: units.Frames


@dataclass(frozen=True, eq=False)
class Case:
    """What the steps of `align` hand on to each other: each takes a case and answers a case."""

    params: dict[str, Any]
    plan: Plan
    found: Found | None = None
    """The answer so far, of the plan's unit clouds."""
    searched: Search | None = None
    """The last search for a better start, if there was one."""
    placed: Placed | None = None
    """All points of the clouds, or those that the network saw where the plan has no others; None
    until they are asked for. It stays when the source is started elsewhere."""
    seconds: dict[str, float] = field(default_factory=lambda: {"compile": 0.0, "run": 0.0})
    """What all steps together took; each adds its own."""

    def solved(self) -> Found:
        """The answer so far, of a case that has one."""
        assert self.found is not None, "the network comes first"
        return self.found
