"""Which edges of a pose graph are wrong, found while it is solved: graduated non-convexity.

Truncated least squares lets an edge count only as far as noise can explain its residual. From a
nearly convex version of it, in which wrong edges pull but do not decide, the problem is made
sharper step by step (Yang, Antonante, Tzoumas & Carlone, RA-L 2020).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import chi2

from cfr_jax.multiway.pose_graph.graph import Edges, chi_squares, solve

# Of right edges, one in ten thousand is further off than this many squared standard deviations.
LIMIT = float(chi2.ppf(0.9999, df=6))
_SHARPER = 1.6  # from one step to the next
_MOST_STEPS = 60


def solve_robustly(
    edges: Edges,
    poses: Float[np.ndarray, "n 4 4"],
    fixed: Bool[np.ndarray, " n"],
    prior: Float[np.ndarray, " e"] | None = None,
) -> tuple[Float[np.ndarray, "n 4 4"], Bool[np.ndarray, " e"]]:
    """The poses, and which edges they agree with; `prior` weighs edges against each other.

    Every scan that is not `fixed` needs edges to a fixed one.
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


# What is left of a rejected edge: too little to matter, enough for a scan that has no other.
_LEAST = 1e-8


def _weights(off: Float[np.ndarray, " e"], control: float) -> Float[np.ndarray, " e"]:
    """Of each edge, by its squared residual; equation 14 of the paper."""
    low, high = control / (control + 1) * LIMIT, (control + 1) / control * LIMIT
    between = np.sqrt(LIMIT * control * (control + 1) / np.maximum(off, 1e-300)) - control
    return np.where(off <= low, 1.0, np.where(off >= high, 0.0, np.clip(between, 0, 1)))
