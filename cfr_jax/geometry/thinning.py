"""Which points of a cloud are used: evenly spread ones, and each place once."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

_OUTER = 0.995  # this share of the points fills the grid; stray points may lie outside
# Where fewer of the used points than this share differ, each place is used once.
_DIFFERENT = 0.9


def subsample(points: Float[np.ndarray, "n 3"], budget: int, seed: int) -> Int[np.ndarray, " m"]:
    """Rows of at most `budget` points, evenly spread: a random one from each voxel of a grid.

    Bisection finds the coarsest grid that still fills at least `budget` voxels; surplus points are
    dropped at random. If no grid fills that many, because points coincide, the rows are drawn at
    random. The same seed gives the same rows.
    """
    n = len(points)
    if n <= budget:
        return np.arange(n)
    rng = np.random.default_rng(seed)
    order = rng.permutation(n)[: 32 * budget]  # enough to find the voxels, and bounds the time
    shuffled = points[order] - np.median(points[order], axis=0)
    # stray points would stretch the grid, so they are moved into its outermost voxels
    reach = float(np.quantile(np.abs(shuffled).max(axis=1), _OUTER))
    reach = max(reach, np.finfo(np.float64).tiny)
    shuffled = np.clip(shuffled, -reach, reach)
    low, high = 0.0, 2.0 * reach
    chosen = np.arange(len(order))
    for _ in range(12):
        voxel = (low + high) / 2
        first = _first_of_each_voxel(shuffled, voxel)
        if len(first) >= budget:
            low, chosen = voxel, first
        else:
            high = voxel
    return np.sort(order[rng.permutation(chosen)[:budget]])


def repeated(points: Float[np.ndarray, "n 3"]) -> bool:
    """Whether many of the points lie in the same places, and these are enough for a cloud."""
    places = len(first_of_each_place(points))
    return 3 <= places < _DIFFERENT * len(points)


def first_of_each_place(points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " m"]:
    """Rows, in order, without those whose point is equal to that of an earlier row."""
    order = np.lexsort(points.T)  # stable: equal points stay in the order of their rows
    new = np.ones(len(points), bool)
    new[1:] = (points[order[1:]] != points[order[:-1]]).any(axis=1)
    return np.sort(order[new])


def _first_of_each_voxel(points: Float[np.ndarray, "n 3"], voxel: float) -> Int[np.ndarray, " m"]:
    # A voxel is centered at zero, because flat and symmetric clouds often have coordinates there. A
    # voxel border at zero would let rounding decide.
    cells = np.floor(points / voxel + 0.5).astype(np.int64)
    cells -= cells.min(axis=0)
    extent = cells.max(axis=0) + 1
    keys = (cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]
    return np.unique(keys, return_index=True)[1]
