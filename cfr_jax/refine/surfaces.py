"""The surfaces that refinements work on, and the fit that they return."""

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
    """Points with normals on the device. `mask` marks the valid rows."""

    points: Float[Array, "n 3"]
    normals: Float[Array, "n 3"]
    mask: Bool[Array, " n"]


@dataclass(frozen=True, eq=False)
class HostSurface:
    """Points on the host, in float64 and without padding."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"] | None = None
    """Unit normals, if the caller has some."""
    thinned_to: int | None = None
    """The number of these points that the initial motion was found from; None if it was found from
    all of them."""
    _made: dict[Hashable, Any] = field(default_factory=dict, repr=False)

    @functools.cached_property
    def tree(self) -> Tree:
        """The KD-tree of all points."""
        return Tree(self.points)

    def once(self, key: Hashable, make: Callable[[], T]) -> T:
        """Returns `make()`, computed once for each `key` and then remembered. Many fits of one
        surface share its trees, covariances and so on in this way."""
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]


def closest(
    source: HostSurface, target: HostSurface, transform: Float[np.ndarray, "4 4"]
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """For each point of the moved source, the row of the closest point of the target, and the
    distance to it. The answer is remembered for the next call with the same motion."""
    key = "closest", target, transform.tobytes()
    return source.once(key, lambda: target.tree.closest(motions.apply(transform, source.points)))


def score(distance: Float[np.ndarray, " n"], cut: float) -> float:
    """The same score as `generalized_icp.scores`, for these distances: 0 is best, and 1 means that
    no point is within the cut."""
    return float(np.mean(1 - (1 - np.minimum(distance / cut, 1) ** 2) ** 3))


@struct.dataclass
class Fit:
    """The answer of a refinement."""

    transform: Float[Array, "4 4"] | Float[np.ndarray, "4 4"]
    """Maps source onto target."""
    improved: Bool[Array, ""] | bool
    """Whether `transform` is the result of the refinement. False means that it scored worse than
    the initial motion, which `transform` then is."""
    converged: Bool[Array, ""] | bool
    """Whether the last stage ended because nothing moved any longer."""
    steps: Int[Array, ""] | int
