"""Bare rows of little-endian float32, as the data sets of driving store their LiDAR scans."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64

from cfr_jax.io.cloud import LARGEST_COORDINATE, CloudFileError, PointCloud
from cfr_jax.io.mesh import Mesh
from cfr_jax.io.naming import HOW_TO_SAY
from cfr_jax.io.table import table_of

_KITTI = ("x", "y", "z", "intensity")
_NUSCENES = ("x", "y", "z", "intensity", "ring")
_MOST_RINGS = 128  # of the largest scanners; colors go to 255
_BRIGHTEST = 255.0
_FARTHEST = 1e5  # meters; beyond are misread bits
# Correlations of rows by chance stay below this many deviations.
_DEVIATIONS = 4.0
_CLEARLY = 0.05
_MOST_COLUMNS = 12
_SAMPLED = 1 << 18


def parse(
    data: bytes, name: str, *, columns: tuple[str, ...] | None = None, whole: bool = False
) -> PointCloud | Mesh:
    """Four columns as in KITTI (x, y, z, reflectance), or five as in nuScenes (with the ring).

    The file does not say which. Five columns are told by a last one that holds numbers of rings;
    four, by reflectances between 0 and 255. In both, the numbers have to repeat every so many.
    Raises CloudFileError where neither fits; `columns` then says how many there are.
    """
    names = _names(data, name) if columns is None else columns
    width = len(names)
    if len(data) % (4 * width):
        raise CloudFileError(f"has {len(data)} bytes, wanted rows of {4 * width} ({width} float32)")
    rows = np.frombuffer(data, "<f4").reshape(-1, width)
    table = table_of(names, [rows[:, k] for k in range(width)], format="Velodyne")
    return table.shape(name, (), whole)


def _names(data: bytes, name: str) -> tuple[str, ...]:
    if len(data) % 4:
        raise CloudFileError(f"has {len(data)} bytes, wanted rows of 16 (four float32)")
    numbers = np.frombuffer(data, "<f4")
    four = len(numbers) % 4 == 0 and _is_kitti(numbers.reshape(-1, 4))
    five = len(numbers) % 5 == 0 and _has_rings(numbers.reshape(-1, 5))
    if five or (four and not name.lower().endswith(".pcd.bin")):
        names = _NUSCENES if five else _KITTI
        better = _better_width(numbers, len(names))
        if better is None:
            return names
        raise CloudFileError(
            f"repeats every {better} numbers and not every {len(names)}; {HOW_TO_SAY}"
        )
    raise CloudFileError(
        f"has {len(data)} bytes that are no rows of 16 as in KITTI (x, y, z, reflectance of 0 to "
        f"255), nor of 20 as in nuScenes (and a ring of 0 to {_MOST_RINGS - 1}); {HOW_TO_SAY}"
    )


def _is_kitti(rows: Float32[np.ndarray, "n 4"]) -> bool:
    bright = rows[:, 3]
    with np.errstate(invalid="ignore"):
        return bool(np.all(~(bright < 0) & ~(bright > _BRIGHTEST))) and _near(rows)


def _has_rings(rows: Float32[np.ndarray, "n 5"]) -> bool:
    rings = rows[:, 4]
    with np.errstate(invalid="ignore"):
        whole = np.all((rings >= 0) & (rings < _MOST_RINGS) & (rings == np.rint(rings)))
        return bool(whole and np.all(rows[:, 3] >= 0)) and _near(rows)


def _near(rows: Float32[np.ndarray, "n k"]) -> bool:
    """Whether no finite coordinate is implausible for a scan."""
    points = rows[:, :3]
    with np.errstate(invalid="ignore"):
        far = (np.abs(points) > _FARTHEST) & (np.abs(points) <= LARGEST_COORDINATE)
    return not bool(far.any())


def _better_width(numbers: Float32[np.ndarray, " k"], width: int) -> int | None:
    """How many columns the numbers have more likely than `width`, if any.

    Numbers of one column are alike, so the sequence correlates with itself at the distance of a
    row. Chance alone gives one over the square root of the length.
    """
    part = numbers[:_SAMPLED]
    part = part[np.isfinite(part)].astype(np.float64)
    if len(part) < 2 * _MOST_COLUMNS:
        return None
    size = np.abs(part)
    others = [
        other
        for other in range(3, _MOST_COLUMNS + 1)
        if other != width and len(numbers) % other == 0
    ]
    # Columns differ in their values, and those about zero in their size.
    for feature in (part, np.log(size + 1e-3 * np.median(size) + 1e-30)):
        alike = _likeness(feature, [width, *others])
        chance = max(_DEVIATIONS / np.sqrt(len(part)), _CLEARLY)
        best = int(np.argmax(alike))
        if alike[best] > alike[0] + chance:
            return others[best - 1]
    return None


def _likeness(numbers: Float64[np.ndarray, " k"], lags: list[int]) -> list[float]:
    """The correlation of numbers with those that come so many later."""
    spread = numbers.std()
    if spread == 0:
        return [0.0] * len(lags)
    numbers = np.clip((numbers - np.median(numbers)) / spread, -4, 4)
    numbers = numbers - numbers.mean()
    power = float(numbers @ numbers) or 1.0
    return [float(numbers[lag:] @ numbers[:-lag]) / power for lag in lags]
