"""What refinements work on, and what they answer."""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from cfr_jax.geometry import motions
from cfr_jax.geometry.trees import Tree

T = TypeVar("T")


@struct.dataclass
class Surface:
    """Points with normals on the device, `mask` marking the valid rows."""

    points: Float[Array, "n 3"]
    normals: Float[Array, "n 3"]
    mask: Bool[Array, " n"]


@dataclass(frozen=True, eq=False)
class HostSurface:
    """Points on the host, in float64 and without padding."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"] | None = None
    """Unit normals, where the caller has some."""
    thinned_to: int | None = None
    """How many of these points the motion to refine was found from; None for all of them."""
    _made: dict[Hashable, Any] = field(default_factory=dict, repr=False)

    @functools.cached_property
    def tree(self) -> Tree:
        """Of all points."""
        return Tree(self.points)

    def once(self, key: Hashable, make: Callable[[], T]) -> T:
        """What `make` made of this surface, when it was first asked for under this `key`: trees,
        covariances and the like, which many fits of one surface share."""
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]


def closest(
    source: HostSurface, target: HostSurface, transform: Float[np.ndarray, "4 4"]
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """The row of the target's point closest to each point of the moved source, and the distance.
    Asked for again, the answer is still there."""
    key = "closest", target, transform.tobytes()
    return source.once(key, lambda: target.tree.closest(motions.apply(transform, source.points)))


@struct.dataclass
class Fit:
    """Answer of a refinement."""

    transform: Float[Array, "4 4"] | Float[np.ndarray, "4 4"]
    """Maps source onto target."""
    improved: Bool[Array, ""] | bool
    """Whether `transform` is not the initial one, kept because the other scored worse."""
    converged: Bool[Array, ""] | bool
    """Whether the last stage ended because nothing moved any more."""
    steps: Int[Array, ""] | int
