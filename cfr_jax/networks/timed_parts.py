"""What networks share when their parts are timed one by one (figure 6 of the paper)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from cfr_jax.geometry import rigid
from cfr_jax.geometry.neighbors import nearest_on_host
from cfr_jax.networks.sinkhorn import Affinity, Form, Match, match

# The names of the parts, in the order of the figures.
NEIGHBORS, FEATURES, ANNEALING = "neighbors", "features", "annealing"
MATCHING, MOTION = "matching and Sinkhorn", "Procrustes"


def on_host(points: Float[np.ndarray, "n 3"], k: int, radius: float) -> Int[np.ndarray, "n k"]:
    """The `k` nearest neighbors of each point within `radius`, searched on the host."""
    return nearest_on_host(points, k, radius=radius)


def matching(form: Form) -> Callable[..., Match]:
    """A function that matches in this form.

    It takes the features of source and target, beta, alpha, the target points, and the passes.
    """

    def matched(source: Any, target: Any, beta: Any, alpha: Any, points: Any, passes: int) -> Match:
        return match(Affinity(source, target, beta, alpha), points, passes=passes, form=form)

    return jax.jit(matched, static_argnums=5)


@jax.jit
def move(points: Float[Array, "n 3"], found: Match) -> Float[Array, "n 3"]:
    """The points, moved by the rigid motion that fits the match."""
    return rigid.apply(rigid.fit_rigid(points, found.targets, found.weights), points)
