"""The input of a network: clouds with normals and neighbors, and the settings."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float, Int32

from cfr_jax.geometry import neighbors as knn
from cfr_jax.geometry import rigid
from cfr_jax.geometry.normals import estimate_normals
from cfr_jax.networks.extraction import Activations
from cfr_jax.networks.features import PairFeature
from cfr_jax.networks.sinkhorn import Form
from cfr_jax.runtime.entries import entry
from cfr_jax.runtime.values import ByValue


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings that change the compiled program. The defaults are the paper's."""

    neighbors: int = 64
    radius: float = 0.3
    """Neighbors farther away are replaced by the nearest one; in radii of the unit sphere."""
    ppf: PairFeature = "dot"
    match: Form = "auto"
    """How correspondences are found. "dense" stores the N x M affinities, "streamed" recomputes
    them whenever they are needed. "auto" streams clouds that are large for the platform. "log
    space" is RPM-Net's form."""
    detach_motion: bool = False
    """Stop gradients at the motion between iterations, as in the paper's training."""
    activations: Activations = "float32"
    """Type of the activations in the heavy extraction. "bfloat16" halves its memory traffic, for
    training on accelerators."""
    # The steps of RPM-Net that the paper removes, to measure what that saves. Weights work best
    # with the settings they were trained with.
    passes: int | None = None
    """Sinkhorn passes in every iteration; None: i passes in iteration i."""
    repeat_annealing: bool = False
    """Predict the annealing again in every iteration, from the current position of the source."""
    repeat_extraction: bool = False
    """Extract the heavy features again in every iteration, from the source as it lies by then,
    instead of passing on the features of the iteration before."""


@struct.dataclass(eq=False)
class Cloud(ByValue):
    """A cloud ready for the network, with normals and neighbors; `mask` marks the valid rows."""

    points: Float[Array, "n 3"]
    normals: Float[Array, "n 3"]
    neighbors: Int32[Array, "n k"]
    mask: Bool[Array, " n"] | None = None


@entry
@functools.partial(jax.jit, static_argnames=("settings",))
def prepare(
    points: Float[Array, "n c"],
    *,
    mask: Bool[Array, " n"] | None = None,
    neighbors: Int32[Array, "n k"] | None = None,
    settings: Settings = Settings(),
) -> Cloud:
    """A `Cloud` from raw points (n, 3), or points and normals (n, 6).

    Missing normals are estimated (`normals.estimate_normals`); missing neighbors are searched on
    the device. With n <= K points, each has n - 1 neighbors. Raises ValueError for wrong shapes.
    """
    check_points("points", points)
    n = points.shape[0]
    if mask is not None and mask.shape != (n,):
        raise ValueError(f"mask: got shape {mask.shape}, wanted ({n},) as there are {n} points")
    if neighbors is not None and (neighbors.ndim != 2 or neighbors.shape[0] != n):
        raise ValueError(f"neighbors: got shape {neighbors.shape}, wanted ({n}, k)")
    points = points.astype(jnp.float64 if points.dtype == jnp.float64 else jnp.float32)
    normals = points[:, 3:] if points.shape[1] == 6 else None
    points = points[:, :3]
    if mask is not None:
        points = jnp.where(mask[:, None], points, 0)
    if neighbors is None:
        k = min(settings.neighbors, n - 1)
        neighbors = knn.nearest(lax.stop_gradient(points), k, radius=settings.radius, mask=mask)
    if normals is None:
        normals = estimate_normals(points, neighbors, mask)
    elif mask is not None:
        normals = jnp.where(mask[:, None], normals, 0)
    return Cloud(points, normals, neighbors, mask)


def moved_by(motion: Float[Array, "4 4"], cloud: Cloud) -> Cloud:
    """The cloud after a motion: points moved, normals rotated."""
    points, normals = rigid.apply(motion, cloud.points), rigid.rotate(motion, cloud.normals)
    return Cloud(points, normals, cloud.neighbors, cloud.mask)


def check_points(name: str, points: Array | np.ndarray) -> None:
    """Raises a ValueError that names the argument if its shape is not that of a cloud."""
    if points.ndim != 2 or points.shape[1] not in (3, 6):
        raise ValueError(
            f"{name}: got shape {points.shape}, wanted (n, 3) points or (n, 6) points and normals"
        )
    if points.shape[0] < 3:
        raise ValueError(f"{name}: got {points.shape[0]} points, wanted at least 3")


def refuse_masked(name: str, cloud: Any, instead: str) -> None:
    """Raises ValueError for an array of numpy with masked values.

    What lies under the mask is no point, and the array alone does not tell whether its row may be
    left out. `instead` says what its owner can do.
    """
    if isinstance(cloud, np.ma.MaskedArray) and np.ma.is_masked(cloud):
        raise ValueError(
            f"{name}: got an array with {np.ma.count_masked(cloud)} masked values, wanted an array "
            f"without ({instead})"
        )
