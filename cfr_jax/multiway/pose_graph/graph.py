"""The pose graph: the poses that agree best with measured motions between scans.

An edge measured M, which maps its source scan onto its target scan. With poses P, its residual is
log(M^-1 P_target^-1 P_source): how far, in the source's frame, the poses are from the measurement.
The poses minimize the sum of squared residuals, each weighed by the edge's information matrix.

scipy's `least_squares` solves it, with the analytic and sparse Jacobian. GTSAM and optimistix would
do as well: but GTSAM has no wheels for all systems and Python versions of this package, optimistix
knows no sparse Jacobians, and the graphs of some thousand scans take seconds here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.optimize import least_squares
from scipy.sparse import linalg

from cfr_jax.geometry import twists

_ROUNDS = 20  # linearizations about new poses; two or three are enough near the answer
_STEPS = 20
_SETTLED = 1e-9  # radians and units of length


@dataclass(frozen=True, eq=False)
class Edges:
    """Measured motions between scans, one a row."""

    source: Int[np.ndarray, " e"]
    target: Int[np.ndarray, " e"]
    transform: Float[np.ndarray, "e 4 4"]
    """Maps the source scan onto the target scan."""
    information: Float[np.ndarray, "e 6 6"]
    """Inverse covariance of the twist d, in the source's frame, by which the measurement is off:
    the true motion is transform @ exp(d)."""

    def __len__(self) -> int:
        return len(self.source)

    def take(self, rows: Int[np.ndarray, " k"] | Bool[np.ndarray, " e"]) -> Edges:
        """Some of the edges."""
        return Edges(
            self.source[rows], self.target[rows], self.transform[rows], self.information[rows]
        )


def residuals(edges: Edges, poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "e 6"]:
    """How far the poses are from each measurement, as a twist in the source's frame."""
    between = twists.inverse(poses[edges.target]) @ poses[edges.source]
    return twists.log(twists.inverse(edges.transform) @ between)


def chi_squares(edges: Edges, poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, " e"]:
    """The squared residuals, in units of their variance: 6 each is what noise alone makes."""
    off = residuals(edges, poses)
    return np.einsum("ei,eij,ej->e", off, edges.information, off)


def solve(
    edges: Edges,
    poses: Float[np.ndarray, "n 4 4"],
    fixed: Bool[np.ndarray, " n"],
    weights: Float[np.ndarray, " e"] | None = None,
) -> Float[np.ndarray, "n 4 4"]:
    """The best poses near `poses`; those that are `fixed` stay.

    Every connected part of the graph needs a fixed scan. `weights` multiply the information.
    """
    weights = np.ones(len(edges)) if weights is None else weights
    held = weights > 0
    edges, weights = edges.take(held), weights[held]
    if not len(edges) or fixed.all():
        return poses
    # Lᵀ of information = L Lᵀ: it makes the residuals' covariance the identity
    whitening = np.linalg.cholesky(edges.information).swapaxes(-1, -2)
    whitening = whitening * np.sqrt(weights)[:, None, None]
    for _ in range(_ROUNDS):
        # about the present poses, where the parameters are zero, so that no turn comes near pi
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
    """The covariance of each pose, given the `fixed` ones; zero for those.

    It is that of the twist d, in the scan's own frame, with true pose = pose @ exp(d).
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
    """Of `_whitened`: two blocks of 6 x 6 for each edge.

    With right Jacobians J: a step d of the source's pose turns the residual r by J(r)^-1 J(x) d,
    one of the target's by -J(r)^-1 Ad(P_source^-1 P_target) J(x) d.
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
