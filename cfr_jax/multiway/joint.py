"""Joint refinement: moves all poses at once until all overlapping scans fit each other.

This is multi-view point-to-plane registration (Chen & Medioni, 1991; Pulli, 1999). A pose graph
only spreads the errors of the pairs, but the surfaces themselves say where the scans lie. Each pair
counts in both directions, with robust weights that depend on the noise of its own distances.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse import linalg

from cfr_jax.geometry import twists
from cfr_jax.multiway.contact import touching
from cfr_jax.multiway.scans import Scan

_REACHES = (3.0, 1.5)  # largest distance of two points that form a pair, in spacings, per stage
_STEPS = (6, 6)  # most steps in each stage
_POINTS = 1200  # source points used in each pair of scans
# Share of the mean curvature. Damping keeps scans where the pose graph put them, along directions
# that no plane constrains.
_DAMPING = 1e-4
_SETTLED = 1e-3  # share of the spacing: a stage ends when no point moves by more than this


def refine(
    scans: Sequence[Scan],
    poses: Float[np.ndarray, "n 4 4"],
    pairs: Int[np.ndarray, "p 2"],
    fixed: Bool[np.ndarray, " n"],
) -> Float[np.ndarray, "n 4 4"]:
    """Refines the poses. `pairs` are rows of scans that overlap. Scans that are `fixed` do not
    move.

    If the scans do not fit better in the end, the poses are returned unchanged.
    """
    if not len(pairs) or fixed.all():
        return poses
    spacing = float(np.median([scan.spacing for scan in scans]))
    found = poses
    for reach, steps in zip(_REACHES, _STEPS, strict=True):
        for _ in range(steps):
            system, pull, _ = _equations(scans, found, pairs, fixed, reach)
            step = linalg.spsolve(system, pull).reshape(-1, 6)
            found = found.copy()
            found[~fixed] = found[~fixed] @ twists.exp(step)
            radii = np.array([scan.radius for scan, no in zip(scans, fixed, strict=True) if not no])
            moved = np.linalg.norm(step[:, :3], axis=1) * radii + np.linalg.norm(
                step[:, 3:], axis=1
            )
            if moved.max() <= _SETTLED * spacing:
                break
    before, after = (
        _equations(scans, each, pairs, fixed, _REACHES[-1])[2] for each in (poses, found)
    )
    return found if after <= before else poses


def _equations(
    scans: Sequence[Scan],
    poses: Float[np.ndarray, "n 4 4"],
    pairs: Int[np.ndarray, "p 2"],
    fixed: Bool[np.ndarray, " n"],
    reach: float,
) -> tuple[sparse.csc_matrix, Float[np.ndarray, " k"], float]:
    """The damped normal equations of one step, and the mean truncated distance to the planes."""
    place = np.where(fixed, -1, np.cumsum(~fixed) - 1)
    count = int((~fixed).sum())
    blocks: dict[tuple[int, int], np.ndarray] = {}
    pull = np.zeros((count, 6))
    cost, terms = 0.0, 0
    for first, second in [*pairs, *pairs[:, ::-1]]:
        source, target = scans[first], scans[second]
        within = reach * max(source.spacing, target.spacing)
        motion = twists.inverse(poses[second]) @ poses[first]
        found = touching(source, target, motion, within, _POINTS)
        heights = found.heights
        used = min(_POINTS, len(source.points))
        cost += float(np.sum(np.minimum(np.abs(heights) / within, 1))) + used - len(heights)
        terms += used
        if not len(heights):
            continue
        spread = max(1.4826 * float(np.median(np.abs(heights))), 0.02 * source.spacing)
        # Geman & McClure's weights: the farther a plane, the more likely it is another surface
        weight = 1 / (spread * (1 + (heights / (3 * spread)) ** 2)) ** 2
        sides = [
            (place[scan], rows)
            for scan, rows in ((first, found.rows), (second, found.target_rows))
            if place[scan] >= 0
        ]
        for one, rows in sides:
            pull[one] -= rows.T @ (weight * heights)
            for other, others in sides:
                held = rows.T @ (weight[:, None] * others)
                blocks[one, other] = blocks.get((one, other), 0) + held
    row, column = np.array(list(blocks), np.int64).reshape(-1, 2).T
    values = np.array(list(blocks.values())).reshape(-1, 6, 6)
    rows, columns = np.broadcast_arrays(
        6 * row[:, None, None] + np.arange(6)[:, None], 6 * column[:, None, None] + np.arange(6)
    )
    system = sparse.csc_matrix(
        (values.reshape(-1), (rows.reshape(-1), columns.reshape(-1))), shape=(6 * count, 6 * count)
    )
    curvature = system.diagonal().reshape(count, 6)
    usual = np.repeat(
        [curvature[:, :3].mean(), curvature[:, 3:].mean()], 3
    ) if count else np.zeros(6)  # fmt: skip
    damping = _DAMPING * np.tile(np.maximum(usual, 1e-12), count)
    return (system + sparse.diags(damping)).tocsc(), pull.reshape(-1), cost / max(terms, 1)
