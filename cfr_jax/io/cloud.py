"""The form that all points from outside take: checked, float64, on the host."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64, Real

from cfr_jax.runtime.messages import Refused

if TYPE_CHECKING:
    from cfr_jax.io.table import Table

# No unit of length makes a larger number a scan (the Earth is 6.4e9 mm from its center), and
# float64 still resolves 1e-4 there. Flipped bits and missing-value marks (1e30) lie beyond.
LARGEST_COORDINATE = 1e12

# Normals printed with two digits are off by less than this; colors are off by much more.
UNIT_TOLERANCE = 0.02
_ROWS_AT_ONCE = 1 << 16  # so that what is between two steps takes little memory


class CloudFileError(Refused):
    """A file could not be read or written; says which file, where in it, and what was wanted."""


class CloudWarning(UserWarning):
    """Something was read by a rule because the file does not say it, or left out on writing.

    `about` is the file or the argument, `note` is what happened to it.
    """

    def __init__(self, about: object, note: str) -> None:
        super().__init__(f"{about}: {note}")
        self.about: str = str(about)
        self.note: str = note


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points, perhaps with unit normals, that are known to be good.

    Construction converts to float64, scales the normals to unit length, and raises a
    `ValueError` that names the first bad row: no points, NaN, infinity, a coordinate beyond
    1e12, a normal without a direction.

    Attributes:
        points: (n, 3) float64, n >= 1, in the unit and the frame they came in.
        normals: (n, 3) float64 of length one, or None.
        name: what to call the cloud in messages and pictures: for a file, its name.
        left_out: how many rows of the file were left out because their x, y or z is NaN or
            infinite, which marks cells without a point.
        notes: sentences about what was read by a rule because the file does not say it.
        table: all columns of the file, if `read` was asked for its properties; else None.
            `write` then writes the table, not only points and normals.
    """

    # Plain arrays: construction takes any numbers, and answers a wrong shape itself.
    points: np.ndarray
    normals: np.ndarray | None = None
    name: str = "cloud"
    left_out: int = 0
    notes: tuple[str, ...] = ()
    table: Table | None = None

    def __post_init__(self) -> None:
        points = checked_points(self.points)
        object.__setattr__(self, "points", points)
        if self.normals is not None:
            object.__setattr__(self, "normals", unit_normals(self.normals, len(points)))

    def __len__(self) -> int:
        return len(self.points)


def as_float64(array: np.ndarray) -> np.ndarray:
    """The array in float64 and C order; itself if it is so already."""
    with np.errstate(invalid="ignore"):  # signaling NaNs, which damaged files hold, would warn
        return np.ascontiguousarray(array, dtype=np.float64)


def checked_points(points: np.ndarray) -> Float64[np.ndarray, "n 3"]:
    """The same points as a contiguous float64 array; a `ValueError` where one is not a point."""
    points = as_float64(points)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points must have the shape (n, 3), got {points.shape}")
    if len(points) == 0:
        raise ValueError("holds no points, wanted at least one")
    # Minimum and maximum pass NaN on, and cost no copy of the cloud.
    if not (-LARGEST_COORDINATE <= points.min() and points.max() <= LARGEST_COORDINATE):
        row = int(np.argmin((np.abs(points) <= LARGEST_COORDINATE).all(axis=1)))
        x, y, z = points[row]
        raise ValueError(
            f"point {row} is ({x:g}, {y:g}, {z:g}), "
            f"wanted finite coordinates within ±{LARGEST_COORDINATE:g}"
        )
    return points


def unit_normals(normals: np.ndarray, count: int) -> Float64[np.ndarray, "n 3"]:
    """Each row scaled to length one; a `ValueError` where a row has no direction."""
    normals = as_float64(normals)
    if normals.shape != (count, 3):
        raise ValueError(f"normals must have the shape ({count}, 3), got {normals.shape}")
    scaled = np.empty_like(normals)
    for start in range(0, count, _ROWS_AT_ONCE):
        part = normals[start : start + _ROWS_AT_ONCE]
        # The largest component first: the square of 1e200 is not a number we could divide by.
        largest = np.maximum(part.max(axis=1), -part.min(axis=1))[:, None]
        bad = ~(np.isfinite(largest[:, 0]) & (largest[:, 0] > 0))
        if bad.any():
            row = int(np.argmax(bad))
            x, y, z = part[row]
            raise ValueError(
                f"normal {start + row} is ({x:g}, {y:g}, {z:g}), wanted a finite direction"
            )
        part = part / largest
        part /= np.sqrt(np.einsum("ij,ij->i", part, part))[:, None]
        scaled[start : start + len(part)] = part
    return scaled


def usable_normals(normals: Real[np.ndarray, "n 3"]) -> Real[np.ndarray, "n 3"] | None:
    """The normals of a file, or None if one of them is zero or not finite.

    Programs write such rows where they could not estimate a normal. A cloud has normals for all
    points or for none: whoever needs them estimates them for all points alike.
    """
    low, high = normals.min(axis=1), normals.max(axis=1)
    whole = np.isfinite(low) & np.isfinite(high) & ((low < 0) | (high > 0))
    return normals if whole.all() else None
