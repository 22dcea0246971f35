"""E57, the exchange format of laser scanners, read by the library pye57."""

from __future__ import annotations

import tempfile
from pathlib import Path
from types import ModuleType

import numpy as np

from cfr_jax.io.budget import check_room
from cfr_jax.io.cloud import CloudFileError, PointCloud
from cfr_jax.io.table import cloud_of_filled, table_of

_MARK = b"ASTM-E57"
_PROPERTIES = {
    "intensity": "intensity",
    "colorRed": "red",
    "colorGreen": "green",
    "colorBlue": "blue",
    "timeStamp": "time",
    "rowIndex": "row",
    "columnIndex": "column",
    "returnIndex": "return_number",
    "returnCount": "number_of_returns",
}


def parse(
    data: bytes, name: str, *, columns: tuple[str, ...] | None = None, whole: bool = False
) -> PointCloud:
    """All scans of the file, each moved by its pose into the common frame.

    Points that a scanner marked as invalid are left out and counted in `left_out`.
    """
    if columns is not None:
        raise CloudFileError("columns: E57 files say themselves what they hold")
    if data[:8] != _MARK:
        raise CloudFileError(f"byte 0: starts with {data[:8]!r}, wanted {_MARK!r}")
    length = int.from_bytes(data[16:24], "little")
    if len(data) < 48 or length != len(data):
        raise CloudFileError(f"byte 16: says {length} bytes, the file has {len(data)}")
    pye57 = _import_pye57()
    # The library opens files by name only.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scan.e57"
        path.write_bytes(data)
        try:
            scans = _scans(pye57, path, len(data), whole)
        except CloudFileError:
            raise
        except Exception as error:  # its own errors, and whatever damaged files bring about
            text = " ".join(str(error).split())
            raise CloudFileError(f"cannot be read as E57: {text:.200}") from None
    names = [key for key in scans[0] if all(key in scan for scan in scans)]
    values = [np.concatenate([scan[key] for scan in scans]) for key in names]
    table = table_of(names, values, format="E57")
    return cloud_of_filled(table.points(), None, name, (), table if whole else None)


def _scans(pye57: ModuleType, path: Path, size: int, whole: bool) -> list[dict[str, np.ndarray]]:
    """The columns of each scan, x, y, z first."""
    file = pye57.E57(str(path))
    try:
        counts = [file.get_header(k).point_count for k in range(file.scan_count)]
        if not counts or sum(counts) == 0:
            raise CloudFileError("holds no points, wanted at least one")
        check_room(sum(counts), 24, size, "points")
        return [_scan(file, k, whole) for k in range(len(counts))]
    finally:
        file.close()


def _scan(file: object, number: int, whole: bool) -> dict[str, np.ndarray]:
    header = file.get_header(number)  # type: ignore[attr-defined]
    raw = file.read_scan_raw(number)  # type: ignore[attr-defined]
    if "cartesianX" in raw:
        points = np.stack([raw[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
        invalid = raw.get("cartesianInvalidState")
    else:
        distance, azimuth, elevation = (
            raw[f"spherical{part}"] for part in ("Range", "Azimuth", "Elevation")
        )
        flat = distance * np.cos(elevation)
        points = np.stack(
            [flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)], axis=1
        )
        invalid = raw.get("sphericalInvalidState")
    points = points.astype(np.float64)
    if header.has_pose():
        points = points @ np.asarray(header.rotation_matrix).T + np.asarray(header.translation)
    if invalid is not None:
        points[np.asarray(invalid) != 0] = np.nan
    found = dict(zip("xyz", points.T, strict=True))
    for key, name in _PROPERTIES.items() if whole else ():
        if key in raw:
            found[name] = raw[key]
    return found


def _import_pye57() -> ModuleType:
    try:
        import pye57
    except ImportError:
        raise CloudFileError(
            'E57 files need the package pye57: pip install "cfr_jax[e57]"'
        ) from None
    return pye57
