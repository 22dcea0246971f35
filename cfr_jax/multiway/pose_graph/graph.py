"""The pose graph: finds the poses that agree best with measured motions between scans.

The measurement M of an edge maps its source scan onto its target scan. For poses P, the residual of
the edge is log(M^-1 P_target^-1 P_source): the difference between the poses and the measurement, in
the source's frame. The poses minimize the sum of squared residuals, each weighted by the edge's
information matrix.

scipy's `least_squares` solves this with the analytic and sparse Jacobian. GTSAM and optimistix
could solve it, too. But GTSAM lacks wheels for some systems and Python versions that this package
supports, and optimistix has no sparse Jacobians. With scipy, a graph of a thousand scans takes
seconds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.optimize import least_squares
from scipy.sparse import linalg

from cfr_jax.geometry import twists

_ROUNDS = 20  # restarts of the solver at new poses; two or three are enough near the answer
_STEPS = 20  # most evaluations in each round
_SETTLED = 1e-9  # radians and units of length


@dataclass(frozen=True, eq=False)
class Edges:
    """Measured motions between scans, one per row."""

    source: Int[np.ndarray, " e"]
    target: Int[np.ndarray, " e"]
    transform: Float[np.ndarray, "e 4 4"]
    """Maps the source scan onto the target scan."""
    information: Float[np.ndarray, "e 6 6"]
    """The inverse covariance of the error of the measurement. The error is a twist d in the
    source's frame: the true motion is transform @ exp(d)."""

    def __len__(self) -> int:
        return len(self.source)

    def take(self, rows: Int[np.ndarray, " k"] | Bool[np.ndarray, " e"]) -> Edges:
        """The edges in these rows."""
        return Edges(
            self.source[rows], self.target[rows], self.transform[rows], self.information[rows]
        )


def residuals(edges: Edges, poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "e 6"]:
    """The difference between the poses and each measurement, as a twist in the source's frame."""
    between = twists.inverse(poses[edges.target]) @ poses[edges.source]
    return twists.log(twists.inverse(edges.transform) @ between)


def chi_squares(edges: Edges, poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, " e"]:
    """The squared residuals in units of their variance. Noise alone makes 6 on average."""
    off = residuals(edges, poses)
    return np.einsum("ei,eij,ej->e", off, edges.information, off)


def solve(
    edges: Edges,
    poses: Float[np.ndarray, "n 4 4"],
    fixed: Bool[np.ndarray, " n"],
    weights: Float[np.ndarray, " e"] | None = None,
) -> Float[np.ndarray, "n 4 4"]:
    """Finds the best poses, starting from `poses`. Scans that are `fixed` do not move.

    Every connected part of the graph needs a fixed scan. `weights` multiply the information.
    """
    weights = np.ones(len(edges)) if weights is None else weights
    held = weights > 0
    edges, weights = edges.take(held), weights[held]
    if not len(edges) or fixed.all():
        return poses
    # Lᵀ, where information = L Lᵀ; it turns the residuals' covariance into the identity
    whitening = np.linalg.cholesky(edges.information).swapaxes(-1, -2)
    whitening = whitening * np.sqrt(weights)[:, None, None]
    for _ in range(_ROUNDS):
        # The parameters are steps from the present poses and start at zero, so no rotation angle
        # comes near pi.
        found = least_squares(
            _whitened,
            np.zeros(6 * int((~fixed).sum())),
            jac=_jacobian,
            args=(edges, poses, fixed, whitening),
            method="trf",
            tr_solver="lsmr",
            x_scale="jac",
            max_nfev=_STEPS,
        )
        poses = _moved(poses, fixed, found.x)
        if np.abs(found.x).max() <= _SETTLED or found.status > 0 and found.nfev < _STEPS:
            break
    return poses


def covariances(
    edges: Edges, poses: Float[np.ndarray, "n 4 4"], fixed: Bool[np.ndarray, " n"]
) -> Float[np.ndarray, "n 6 6"]:
    """The covariance of each pose relative to the `fixed` ones, for which it is zero.

    It is the covariance of the twist d in the scan's own frame, with true pose = pose @ exp(d).
    """
    found = np.zeros((len(poses), 6, 6))
    if not len(edges) or fixed.all():
        return found
    whitening = np.linalg.cholesky(edges.information).swapaxes(-1, -2)
    slope = _jacobian(np.zeros(6 * int((~fixed).sum())), edges, poses, fixed, whitening)
    factor = linalg.splu((slope.T @ slope).tocsc())
    for row, scan in enumerate(np.flatnonzero(~fixed)):
        columns = np.zeros((slope.shape[1], 6))
        columns[6 * row : 6 * row + 6] = np.eye(6)
        found[scan] = factor.solve(columns)[6 * row : 6 * row + 6]
    return (found + found.swapaxes(-1, -2)) / 2


def _moved(
    poses: Float[np.ndarray, "n 4 4"], fixed: Bool[np.ndarray, " n"], steps: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "n 4 4"]:
    moved = poses.copy()
    moved[~fixed] = poses[~fixed] @ twists.exp(steps.reshape(-1, 6))
    return moved


def _whitened(
    steps: Float[np.ndarray, " k"],
    edges: Edges,
    poses: Float[np.ndarray, "n 4 4"],
    fixed: Bool[np.ndarray, " n"],
    whitening: Float[np.ndarray, "e 6 6"],
) -> Float[np.ndarray, " r"]:
    off = residuals(edges, _moved(poses, fixed, steps))
    return np.einsum("eij,ej->ei", whitening, off).reshape(-1)


def _jacobian(
    steps: Float[np.ndarray, " k"],
    edges: Edges,
    poses: Float[np.ndarray, "n 4 4"],
    fixed: Bool[np.ndarray, " n"],
    whitening: Float[np.ndarray, "e 6 6"],
) -> sparse.csr_matrix:
    """The Jacobian of `_whitened`, which has two blocks of 6 x 6 for each edge.

    With right Jacobians J, a step d of the source's pose changes the residual r by J(r)^-1 J(x) d.
    A step d of the target's pose changes it by -J(r)^-1 Ad(P_source^-1 P_target) J(x) d.
    """
    moved = _moved(poses, fixed, steps)
    away = twists.inverse(moved[edges.source]) @ moved[edges.target]
    before = whitening @ np.linalg.inv(twists.left_jacobian(-residuals(edges, moved)))
    own = np.zeros((len(poses), 6, 6))
    own[~fixed] = twists.left_jacobian(-steps.reshape(-1, 6))
    blocks = np.concatenate(
        [before @ own[edges.source], -before @ twists.adjoint(away) @ own[edges.target]]
    )
    place = np.cumsum(~fixed) - 1
    scans = np.concatenate([edges.source, edges.target])
    rows = np.concatenate([np.arange(len(edges))] * 2)
    free = ~fixed[scans]
    blocks, rows, columns = blocks[free], rows[free], place[scans[free]]
    row, column = np.broadcast_arrays(
        6 * rows[:, None, None] + np.arange(6)[:, None],
        6 * columns[:, None, None] + np.arange(6),
    )
    return sparse.csr_matrix(
        (blocks.reshape(-1), (row.reshape(-1), column.reshape(-1))),
        shape=(6 * len(edges), len(steps)),
    )
