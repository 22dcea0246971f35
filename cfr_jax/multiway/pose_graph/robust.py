"""Finds the wrong edges of a pose graph while solving it, by graduated non-convexity.

In truncated least squares, the cost of an edge stops growing where noise cannot explain its
residual. The solver starts from a nearly convex version of this problem, in which wrong edges pull
but do not decide, and makes it sharper step by step (Yang, Antonante, Tzoumas & Carlone, RA-L
2020).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import chi2

from cfr_jax.multiway.pose_graph.graph import Edges, chi_squares, solve

# One right edge in ten thousand is off by more than this many squared standard deviations.
LIMIT = float(chi2.ppf(0.9999, df=6))
_SHARPER = 1.6  # the factor on the control parameter from one step to the next
_MOST_STEPS = 60


def solve_robustly(
    edges: Edges,
    poses: Float[np.ndarray, "n 4 4"],
    fixed: Bool[np.ndarray, " n"],
    prior: Float[np.ndarray, " e"] | None = None,
) -> tuple[Float[np.ndarray, "n 4 4"], Bool[np.ndarray, " e"]]:
    """Returns the poses, and whether each edge agrees with them. `prior` weights the edges relative
    to each other.

    A path of edges must connect every scan to one that is `fixed`.
    """
    prior = np.ones(len(edges)) if prior is None else prior
    poses = solve(edges, poses, fixed, prior)
    off = chi_squares(edges, poses)
    if not len(edges) or off.max() <= LIMIT:
        return poses, np.ones(len(edges), bool)
    control = LIMIT / (2 * off.max() - LIMIT)
    for _ in range(_MOST_STEPS):
        weights = _weights(off, control)
        poses = solve(edges, poses, fixed, prior * np.maximum(weights, _LEAST))
        off = chi_squares(edges, poses)
        if np.all((weights < _LEAST) | (weights > 1 - _LEAST)):
            break
        control *= _SHARPER
    kept = off <= LIMIT
    return solve(edges, poses, fixed, prior * np.maximum(kept, _LEAST)), kept


# The weight that a rejected edge keeps. It is too small to matter, but enough to hold a scan that
# has no other edge.
_LEAST = 1e-8


def _weights(off: Float[np.ndarray, " e"], control: float) -> Float[np.ndarray, " e"]:
    """The weight of each edge, from its squared residual (equation 14 of the paper)."""
    low, high = control / (control + 1) * LIMIT, (control + 1) / control * LIMIT
    between = np.sqrt(LIMIT * control * (control + 1) / np.maximum(off, 1e-300)) - control
    return np.where(off <= low, 1.0, np.where(off >= high, 0.0, np.clip(between, 0, 1)))
