"""KD-trees on the host: those of small_gicp, which are several times as fast, or else SciPy's."""

from __future__ import annotations

import functools
import os
from typing import Any

import numpy as np
from jaxtyping import Float, Int

_SAMPLED = 1 << 13  # points whose nearest neighbors tell the spacing of a cloud
# Fewer queries than this are answered by one thread, within a quarter of a millisecond. To share
# them would halve that, but cost a time slice where other processes want the same cores.
_SHARED = 1 << 11


class Tree:
    """A KD-tree of points. The same points give the same answers, whatever the number of cores:
    threads share the queries, and each query is answered alone."""

    def __init__(self, points: Float[np.ndarray, "m 3"]):
        self.points: Float[np.ndarray, "m 3"] = np.ascontiguousarray(points, np.float64)

    @functools.cached_property
    def of_library(self) -> Any:
        """The tree of small_gicp; None where that is not installed."""
        try:
            import small_gicp
        except ImportError:
            return None
        return small_gicp.KdTree(self.points)

    @functools.cached_property
    def _of_scipy(self) -> Any:
        # imported here: a fifth of a second that others need not wait for
        from scipy.spatial import cKDTree

        return cKDTree(self.points)

    def nearest(
        self, queries: Float[np.ndarray, "n 3"], k: int
    ) -> tuple[Int[np.ndarray, "n k"], Float[np.ndarray, "n k"]]:
        """Rows of the `k` points nearest to each query, the nearest first, and their distances.
        Needs k <= m."""
        queries = np.ascontiguousarray(queries, np.float64)
        if not len(queries):
            return np.zeros((0, k), np.int64), np.zeros((0, k))
        if self.of_library is None:
            distance, rows = self._of_scipy.query(queries, k, workers=-1)
            return rows.reshape(-1, k), distance.reshape(-1, k)
        search = self.of_library.batch_knn_search
        threads = cores() if len(queries) >= _SHARED else 1
        rows, square = search(queries, k, num_threads=threads)
        return np.asarray(rows).astype(np.int64), np.sqrt(np.asarray(square))

    def closest(
        self, queries: Float[np.ndarray, "n 3"]
    ) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Row of the point closest to each query, and its distance."""
        rows, distance = self.nearest(queries, 1)
        return rows[:, 0], distance[:, 0]

    @functools.cached_property
    def spacing(self) -> float:
        """Median distance of a point to the nearest other point; of a sample of large clouds.
        Points that come several times count once, where most of them do."""
        sample = self.points[:: -(-len(self.points) // _SAMPLED)]
        found = float(np.median(self.nearest(sample, 2)[1][:, 1]))
        if found > 0:
            return found
        places = np.unique(self.points, axis=0)
        return Tree(places).spacing if 1 < len(places) < len(self.points) else found


def cores() -> int:
    """How many this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
