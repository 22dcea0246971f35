"""The K nearest neighbors of each point: exact, without the point itself, far ones replaced.

There are three ways to find the same sets. `nearest` is pure JAX and lowers to one search on CPUs
and another on accelerators. `nearest_on_host` is for clouds that are still in host memory. Only the
*set* of a point's neighbors matters to the network, so their order is not specified. All three
break ties in favor of the lower index. (Distances that differ only in the last bit or two of
float32 may fall on either side of the K-th place.) Everything downstream takes indices.
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int32

from cfr_jax.geometry.closest import far_where_masked, squares
from cfr_jax.geometry.selection import k_smallest, k_smallest_of_groups, nth_set_bit, pack

_BLOCK = 1 << 16  # distances held at a time on a CPU, so that they stay in a core's cache
# On the host, up to this many points, comparing all pairs by blocks of rows is faster than the tree
# (1,024 points: 5 ms, the tree 13 ms; 2,048 points: 25 and 31 ms).
_FEW = 1536
_HOST_ROWS = 64
_TREE_ROWS = 1 << 13


def nearest(
    points: Float[Array, "n 3"],
    k: int,
    *,
    radius: float | None = None,
    mask: Bool[Array, " n"] | None = None,
) -> Int32[Array, "n k"]:
    """Indices of the `k` nearest other points of each point.

    A neighbor farther away than `radius` is replaced by the nearest one, which is kept even if it
    lies outside. Points where `mask` is false are never neighbors. If a cloud has fewer than k + 1
    valid points, the nearest one is repeated in the same way. Indices have no gradient. Memory
    grows with n, not with n^2, because rows are processed in blocks. Raises ValueError unless
    1 <= k <= n - 1.
    """
    n = points.shape[0]
    if not 1 <= k <= n - 1:
        raise ValueError(
            f"k: got {k} neighbors for a cloud of {n} points, wanted 1 <= k <= {n - 1}"
        )
    points = points.astype(jnp.float32)  # as on the host; the search works on the bits of float32
    limit = jnp.inf if radius is None else radius * radius
    return lax.platform_dependent(
        points,
        mask,
        cpu=lambda points, mask: _nearest_by_bits(points, mask, k, limit),
        default=lambda points, mask: _nearest_by_groups(points, mask, k, limit),
    )


def _nearest_by_bits(
    points: Float[Array, "n 3"], mask: Bool[Array, " n"] | None, k: int, limit: float
) -> Int32[Array, "n k"]:
    """`nearest` on a CPU."""
    n = points.shape[0]

    def choose(row: Array, square: Array) -> Array:
        if mask is not None:
            square = jnp.where(mask, square, jnp.inf)
        square = jnp.where(row == jnp.arange(n, dtype=jnp.int32), jnp.inf, square)
        first = jnp.argmin(square, axis=1).astype(jnp.int32)
        chosen = k_smallest(square, k)
        far = ~(jnp.take_along_axis(square, chosen, axis=1) <= limit)
        nowhere = jnp.isinf(jnp.take_along_axis(square, chosen, axis=1))
        far |= nowhere
        if k == n - 1 and mask is not None:  # points come before padding (`others`)
            order = jnp.argsort(nowhere, axis=1, stable=True)
            chosen, far = (jnp.take_along_axis(part, order, axis=1) for part in (chosen, far))
        return jnp.where(far, first[:, None], chosen)

    return _by_rows(points, choose)


def _nearest_by_groups(
    points: Float[Array, "n 3"], mask: Bool[Array, " n"] | None, k: int, limit: float, **sizes: int
) -> Int32[Array, "n k"]:
    """`nearest` on an accelerator, in a handful of kernels."""

    def square_of(row: Array, query: Array, column: Array, point: Array) -> Array:
        return jnp.where(row == column, jnp.inf, squares(query, point))

    square, chosen = k_smallest_of_groups(
        points, far_where_masked(points, mask), k, square_of, **sizes
    )
    return jnp.where((square <= limit) & (square < jnp.inf), chosen, chosen[:, :1])


def first_in_ball(
    points: Float[Array, "n 3"], k: int, radius: float, mask: Bool[Array, " n"] | None = None
) -> Int32[Array, "n k"]:
    """For each point, the first `k` other valid points, by index, that lie within `radius` of it.

    If there are fewer, the point itself fills the missing places. These are RPM-Net's
    neighborhoods: not the nearest points, and with a repeated center where a ball is sparse. A
    rigid motion does not change them.
    """
    return lax.platform_dependent(
        points,
        mask,
        cpu=lambda points, mask: _first_by_bits(points, mask, k, radius),
        default=lambda points, mask: _first_by_groups(points, mask, k, radius),
    )


def _first_by_bits(
    points: Float[Array, "n 3"], mask: Bool[Array, " n"] | None, k: int, radius: float
) -> Int32[Array, "n k"]:
    def choose(row: Array, square: Array) -> Array:
        inside = (square <= radius * radius) & (row != jnp.arange(points.shape[0], dtype=jnp.int32))
        if mask is not None:
            inside &= mask
        rank = jnp.arange(k, dtype=jnp.int32)[None, :]
        found = nth_set_bit(pack(inside), jnp.broadcast_to(rank, (len(row), k)))
        return jnp.where(rank < jnp.sum(inside, axis=1, keepdims=True), found, row)

    return _by_rows(points, choose)


def _first_by_groups(
    points: Float[Array, "n 3"], mask: Bool[Array, " n"] | None, k: int, radius: float, **sizes: int
) -> Int32[Array, "n k"]:
    def place_of(row: Array, query: Array, column: Array, point: Array) -> Array:
        inside = (squares(query, point) <= radius * radius) & (row != column)
        return jnp.where(inside, column.astype(query.dtype), jnp.inf)

    n = points.shape[0]
    table = far_where_masked(points, mask)
    place, found = k_smallest_of_groups(points, table, min(k, n), place_of, **sizes)
    row = jnp.arange(n, dtype=jnp.int32)[:, None]
    missing = jnp.broadcast_to(row, (n, max(0, k - n)))
    return jnp.concatenate([jnp.where(place < jnp.inf, found, row), missing], axis=1)


def _by_rows(
    points: Float[Array, "n 3"], choose: Callable[[Array, Array], Array]
) -> Int32[Array, "n k"]:
    """Calls `choose(row, square)` on blocks of r rows and joins the results to (n, k).

    `row` (r, 1) has the rows' indices and `square` (r, n) their squared distances to all points.
    `choose` returns their neighbors (r, k).
    """
    n = points.shape[0]
    rows = max(1, min(n, _BLOCK // n))
    blocks = -(-n // rows)
    queries = jnp.pad(points, ((0, blocks * rows - n), (0, 0)))

    def block(start: Array) -> Array:
        here = lax.dynamic_slice_in_dim(queries, start, rows)
        square = squares(here[:, None], points)
        return choose((start + jnp.arange(rows, dtype=jnp.int32))[:, None], square)

    found = lax.map(block, rows * jnp.arange(blocks, dtype=jnp.int32))
    return found.reshape(blocks * rows, -1)[:n]


def others(mask: Bool[Array, " n"] | None, k: int) -> Bool[Array, " k"] | None:
    """Which of the k columns of neighbors are no padding; None where all are, as in most clouds.

    In a cloud of k + 1 points, each valid point has all others as neighbors, and columns are left
    if not all points are valid. They hold the nearest neighbor again.
    """
    if mask is None or k < len(mask) - 1:
        return None
    return jnp.arange(k, dtype=jnp.int32) < jnp.sum(mask, dtype=jnp.int32) - 1


def nearest_on_host(
    points: np.ndarray, k: int, *, radius: float | None = None, workers: int = 1
) -> np.ndarray:
    """`nearest` for an (n, 3) cloud in host memory; returns (n, k) int32.

    For small clouds (up to 1,536 points) it compares all pairs. For larger ones it uses a KD-tree
    with `workers` threads. The tree measures in float64, the network in float32. So the tree
    returns a few more neighbors than wanted, and these are measured again in float32, which breaks
    ties as on the device. (Only if more than a few hundred points tie does the tree choose among
    them.)
    """
    points = np.asarray(points, np.float32)
    n = len(points)
    if not 1 <= k <= n - 1:
        raise ValueError(
            f"k: got {k} neighbors for a cloud of {n} points, wanted 1 <= k <= {n - 1}"
        )
    keys = _among_all(points, k) if n <= _FEW else _in_tree(points, k, workers)
    found = (keys & 0xFFFFFFFF).astype(np.int32)
    if radius is not None:
        nearest_one = (keys.min(axis=1) & 0xFFFFFFFF).astype(np.int32)
        inside = _square_of(keys) <= np.float32(radius) ** 2
        found = np.where(inside, found, nearest_one[:, None])
    return found


def _among_all(points: np.ndarray, k: int) -> np.ndarray:
    """Keys of the k nearest other points of each point, by comparing all pairs."""
    n = len(points)
    columns, index = np.ascontiguousarray(points.T), np.arange(n)
    blocks = []
    for rows in np.array_split(index, -(-n // _HOST_ROWS)):
        x, y, z = ((axis[rows, None] - axis) ** 2 for axis in columns)
        square = x + y + z
        square[np.arange(len(rows)), rows] = np.inf
        blocks.append(_smallest(square, index, k))
    return np.concatenate(blocks)


def _in_tree(points: np.ndarray, k: int, workers: int) -> np.ndarray:
    """The same from a KD-tree, in blocks of rows, because it returns many more than are kept."""
    n = len(points)
    # imported here because it takes a fifth of a second, which small clouds do not need
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    keys = np.empty((n, k), np.int64)
    for rows in np.array_split(np.arange(n), -(-n // _TREE_ROWS)):
        for more in (8, 256):  # on a lattice, 8 more are not enough
            wide = min(n, k + more)
            near = tree.query(points[rows], wide, workers=workers)[1].reshape(len(rows), wide)
            offset = points[near] - points[rows, None]
            square = offset[..., 0] ** 2 + offset[..., 1] ** 2 + offset[..., 2] ** 2
            farthest = square.max(axis=1)
            square[near == rows[:, None]] = np.inf
            keys[rows] = _smallest(square, near, k)
            last = _square_of(keys[rows]).max(axis=1)
            rows = rows[last == farthest] if wide < n else rows[:0]
    return keys


def _smallest(square: np.ndarray, index: np.ndarray, k: int) -> np.ndarray:
    """Keys of each row's k smallest distances, in no particular order.

    A key holds the bits of the distance in its upper half and the point's index in its lower half.
    The bits are monotonic because no distance is negative. So ties go to the lower index, and numpy
    partitions integers with vector instructions.
    """
    keys = square.view(np.int32).astype(np.int64) << 32 | index
    keys.partition(k - 1, axis=1)
    return keys[:, :k].copy()


def _square_of(keys: np.ndarray) -> np.ndarray:
    return (keys >> 32).astype(np.int32).view(np.float32)
