"""Generalized ICP (Segal, Haehnel & Thrun, 2009), by small_gicp."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from cfr_jax import refine
from cfr_jax.evaluation.baselines.start import Start, initial
from cfr_jax.io import PointCloud
from cfr_jax.refine.surfaces import HostSurface


def register(
    source: PointCloud,
    target: PointCloud,
    *,
    distances: tuple[float, ...],
    start: Start = "centroid",
    neighbors: int = 20,
    iterations: int = 100,
) -> Float[np.ndarray, "4 4"]:
    """GICP with a rejection distance that shrinks along `distances`; `iterations` for each.

    The covariance of a point comes from its `neighbors` nearest points; normals are not used.
    """
    surfaces = HostSurface(source.points), HostSurface(target.points)
    options = {"distances": distances, "neighbors": neighbors, "iterations": iterations}
    found = refine.named("small_gicp")(*surfaces, initial(source, target, start), **options)
    return np.asarray(found.transform)
