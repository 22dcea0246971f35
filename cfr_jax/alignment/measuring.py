"""The quality of a motion on all points of the clouds, measured on the host by KD-trees."""

from __future__ import annotations

import numpy as np
from flax import struct
from jaxtyping import Float

from cfr_jax.refine.surfaces import HostSurface, closest


@struct.dataclass
class Measured:
    """The part of `quality.Quality` that can be told of millions of points in little time."""

    fitness: Float[np.ndarray, ""]
    inlier_rmse: Float[np.ndarray, ""]
    overlap: Float[np.ndarray, ""]
    moments: Float[np.ndarray, "4 4"]


def measure(
    source: HostSurface, target: HostSurface, transform: Float[np.ndarray, "4 4"], distance: float
) -> Measured:
    """Fitness, inlier error, overlap and moments of `transform` (source onto target), in float64,
    as `quality.measure` defines them: points within `distance` are inliers."""
    rows, away = closest(source, target, transform)
    inlier = away <= distance
    near = away[inlier]
    partners = target.points[rows[inlier]]
    partners = np.concatenate([partners, np.ones((len(partners), 1))], axis=1)
    return Measured(
        fitness=np.asarray(np.mean(inlier)),
        inlier_rmse=np.asarray(np.sqrt(np.mean(near**2)) if len(near) else 0.0),
        overlap=np.asarray(np.mean(away <= 2 * target.tree.spacing)),
        moments=partners.T @ partners,
    )
