"""What a primitive of glTF stands for: its points and triangles, unfolded a block at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from cfr_jax.io.cloud import CloudFileError

POINTS, TRIANGLES, STRIP, FAN = 0, 4, 5, 6
SURFACES = (TRIANGLES, STRIP, FAN)
_AT_ONCE = 1 << 16


@dataclass(frozen=True, eq=False)
class Primitive:
    """Rows of a buffer, as they lie there: nothing is copied before it is needed.

    Attributes:
        positions: (n, 3), floats or integers; `scale` is what normalized integers are divided by.
        corners: (m,) integers that name positions; None for all of them in order.
        mode: what the corners are, by glTF's number.
    """

    positions: np.ndarray
    scale: float | None
    corners: np.ndarray | None
    mode: int

    @property
    def points(self) -> int:
        """How many points there are to hold."""
        return self._named if self.mode == POINTS else len(self.positions)

    @property
    def triangles(self) -> int:
        if self.mode == POINTS:
            return 0
        return self._named // 3 if self.mode == TRIANGLES else max(self._named - 2, 0)

    @property
    def _named(self) -> int:
        return len(self.positions) if self.corners is None else len(self.corners)

    def blocks_of_points(self) -> Iterator[Float64[np.ndarray, "k 3"]]:
        for start in range(0, self.points, _AT_ONCE):
            stop = min(start + _AT_ONCE, self.points)
            if self.mode == POINTS:
                part = self.positions[self._corners(np.arange(start, stop))]
            else:
                part = self.positions[start:stop]
            part = part.astype(np.float64)
            yield part if self.scale is None else np.maximum(part / self.scale, -1.0)

    def blocks_of_triangles(self) -> Iterator[Int64[np.ndarray, "k 3"]]:
        """Triangles of three indices; the corners of a strip all run around the same way."""
        for start in range(0, self.triangles, _AT_ONCE):
            first = np.arange(start, min(start + _AT_ONCE, self.triangles))
            if self.mode == TRIANGLES:
                places = [3 * first, 3 * first + 1, 3 * first + 2]
            elif self.mode == FAN:
                places = [0 * first, first + 1, first + 2]
            else:
                odd = first % 2  # every other triangle of a strip runs the other way around
                places = [first + odd, first + 1 - odd, first + 2]
            yield self._corners(np.stack(places, axis=1))

    def _corners(self, places: Int64[np.ndarray, "*shape"]) -> Int64[np.ndarray, "*shape"]:
        if self.corners is None:
            return places
        corners = self.corners[places].astype(np.int64)
        if corners.size and corners.max() >= len(self.positions):
            raise CloudFileError(
                f"a primitive names vertex {corners.max()}, wanted 0 to {len(self.positions) - 1}"
            )
        return corners
