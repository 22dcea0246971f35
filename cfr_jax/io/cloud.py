"""The one form in which points come in from outside: checked, float64, on the host."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Real

from cfr_jax.runtime.words import Refused

# No unit of length makes a larger number a scan (the Earth is 6.4e9 mm from its center), and
# float64 still resolves 1e-4 there. Flipped bits and missing-value marks (1e30) lie beyond.
LARGEST_COORDINATE = 1e12

# Normals printed with two digits are off by less than this; colors are off by much more.
UNIT_TOLERANCE = 0.02


class CloudFileError(Refused):
    """A file could not be read or written; says which file, where in it, and what was wanted."""


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
        left_out: rows left out on reading because they carry no point, which organized PCD
            clouds mark by NaN.
    """

    # Plain arrays: construction takes any numbers, and answers a wrong shape itself.
    points: np.ndarray
    normals: np.ndarray | None = None
    name: str = "cloud"
    left_out: int = 0

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
    # The largest component first: the square of 1e200 is not a number we could divide by.
    largest = np.maximum(normals.max(axis=1), -normals.min(axis=1))[:, None]
    bad = ~(np.isfinite(largest[:, 0]) & (largest[:, 0] > 0))
    if bad.any():
        row = int(np.argmax(bad))
        x, y, z = normals[row]
        raise ValueError(f"normal {row} is ({x:g}, {y:g}, {z:g}), wanted a finite direction")
    normals = normals / largest
    normals /= np.sqrt(np.einsum("ij,ij->i", normals, normals))[:, None]
    return normals


def usable_normals(normals: Real[np.ndarray, "n 3"]) -> Real[np.ndarray, "n 3"] | None:
    """The normals of a file, or None if one of them is zero or not finite.

    Programs write such rows where they could not estimate a normal. A cloud has normals
    everywhere or not at all: whoever needs them estimates them for all points alike.
    """
    low, high = normals.min(axis=1), normals.max(axis=1)
    whole = np.isfinite(low) & np.isfinite(high) & ((low < 0) | (high > 0))
    return normals if whole.all() else None


def cloud_of_filled(points: np.ndarray, normals: np.ndarray | None, name: str) -> PointCloud:
    """The rows of an organized cloud that hold a point, with their normals if all are usable.

    Rows with a NaN in x, y or z are cells without a point: left out, and counted in `left_out`.
    Raises ValueError where no row is left.
    """
    filled = ~np.isnan(points).any(axis=1)
    left_out = len(points) - int(np.count_nonzero(filled))
    if left_out and left_out == len(points):
        raise ValueError(f"all {left_out} points are NaN, wanted at least one that is not")
    if left_out:
        points, normals = points[filled], None if normals is None else normals[filled]
    usable = None if normals is None or not len(points) else usable_normals(normals)
    return PointCloud(points, usable, name, left_out)


# More numbers than this to a point are not seen; three long rows are a cloud on its side.
_MOST_COLUMNS = 64


def cloud_from_table(table: np.ndarray, name: str) -> PointCloud:
    """A cloud from rows of x, y, z and perhaps more.

    Of exactly six columns the last three are normals if all of them are of about unit length;
    otherwise they are colors or the like, and left out as every other column is.
    """
    if table.ndim != 2 or table.shape[1] < 3:
        raise ValueError(f"wanted rows of x, y, z and perhaps more, got the shape {table.shape}")
    if len(table) <= 6 and table.shape[1] > _MOST_COLUMNS:
        raise ValueError(
            f"got the shape {table.shape}, wanted a row for each point: is it transposed (.T)?"
        )
    normals = None
    if table.shape[1] == 6 and len(table):
        candidate = as_float64(table[:, 3:])
        with np.errstate(over="ignore"):
            squares = np.einsum("ij,ij->i", candidate, candidate)
        # NaN compares false: rows that are no numbers are no normals.
        if np.all(np.abs(squares - 1.0) <= 2.0 * UNIT_TOLERANCE):
            normals = candidate
    return PointCloud(table[:, :3], normals, name)
