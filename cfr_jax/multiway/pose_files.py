"""Reads poses from files of other programs, to start from, and writes poses for other programs.

A pose maps a scan into the model's frame. The suffix or the name of a file gives its format:

- `.json`: {"poses": {name: 4x4}}, as `cfr merge` writes it, together with much else
- `.txt`, `.kitti`: KITTI, the first three rows of the matrix, with a line for each scan in order
- `.tum`: TUM, `time x y z qx qy qz qw`; the time is the number of the scan, from 0
- `images.txt`: COLMAP, `id qw qx qy qz x y z camera name` for the inverse pose, on every other line
- `.conf`: the Stanford repository, `bmesh name x y z qx qy qz qw`
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from cfr_jax.geometry import motions
from cfr_jax.runtime.atomic import write_atomically

SUFFIXES = (".json", ".txt", ".kitti", ".tum", ".conf")
_LARGEST_FILE = 1 << 26
_COLMAP = "images.txt"

Poses = Mapping[str, Float[np.ndarray, "4 4"]]


def read_poses(path: Path, names: Sequence[str]) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Reads the poses in a file, by the name of the scan. Scans without a pose are left out.

    In formats without names, lines are in the order of `names`. In a text file, the number of
    columns tells the format. Raises ValueError, with the file and line, if the file has no poses,
    or none of these scans.
    """
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise ValueError("the file is too large for poses")
        text = path.read_text("utf-8-sig")
        found = _parsed(path, text, names)
        known = {name: pose for name, pose in found.items() if name in names}
        if not known:
            raise ValueError(f"it has none of the scans ({', '.join(list(found)[:3])} …)")
        return {name: motions.check_rigid(name, pose) for name, pose in known.items()}
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise ValueError(f"{path}: wanted poses: {error}") from error


def write_poses(path: Path, poses: Poses, names: Sequence[str]) -> None:
    """Writes the poses of scans, in the order of `names`, in the format of the file's name.

    KITTI files have no names, so a scan without a pose simply has no line in them. The JSON written
    here has only the poses; `cfr merge` writes a JSON file with everything else that is known.
    """
    held = [(names.index(name), name, poses[name]) for name in names if name in poses]
    suffix = path.suffix.lower()
    if path.name == _COLMAP:
        lines = [line for each in held for line in _colmap(*each)]
    elif suffix == ".tum":
        lines = [_row(float(index), *_place(pose)) for index, _, pose in held]
    elif suffix == ".conf":
        lines = [_conf(name, pose) for _, name, pose in held]
    elif suffix == ".json":
        lines = [json.dumps({"poses": {name: pose.tolist() for _, name, pose in held}}, indent=1)]
    else:
        lines = [_row(*pose[:3].reshape(-1)) for _, _, pose in held]
    write_atomically(path, ("\n".join(lines) + "\n").encode())


def _parsed(path: Path, text: str, names: Sequence[str]) -> dict[str, np.ndarray]:
    if path.suffix.lower() == ".json":
        poses = json.loads(text)["poses"]
        return {name: np.asarray(pose, np.float64) for name, pose in poses.items()}
    rows = [
        (number, line.split())
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if path.suffix.lower() == ".conf":
        return dict(_from_conf(*row) for row in rows if row[1][0] == "bmesh")
    if path.name == _COLMAP or (rows and len(rows[0][1]) == 10):
        return dict(_from_colmap(*row) for row in rows if len(row[1]) == 10)
    made = {}
    for order, (number, cells) in enumerate(rows):
        values = _numbers(number, cells, (8, 12))
        tum = len(values) == 8
        # in TUM, the time is the number of a scan if all times can be; otherwise lines are in order
        index = int(values[0]) if tum and _counting(rows, len(names)) else order
        if index >= len(names):
            raise ValueError(f"line {number} is for scan {index}, but there are only {len(names)}")
        made[names[index]] = _pose(values[1:4], values[4:]) if tum else _matrix(values)
    return made


def _counting(rows: Sequence[tuple[int, list[str]]], count: int) -> bool:
    times = [float(cells[0]) for _, cells in rows]
    return all(time.is_integer() and 0 <= time < count for time in times) and len(
        set(times)
    ) == len(times)


def _numbers(number: int, cells: Sequence[str], counts: tuple[int, ...]) -> list[float]:
    try:
        values = [float(cell) for cell in cells]
    except ValueError as error:
        raise ValueError(f"line {number}: {error}") from None
    if len(values) not in counts or not np.isfinite(values).all():
        raise ValueError(
            f"line {number} has {len(values)} numbers, wanted {' or '.join(map(str, counts))}"
        )
    return values


def _matrix(values: Sequence[float]) -> np.ndarray:
    return np.vstack([np.reshape(values, (3, 4)), (0.0, 0.0, 0.0, 1.0)])


def _pose(place: Sequence[float], quaternion: Sequence[float]) -> np.ndarray:
    turn = np.asarray(quaternion, np.float64)
    if not np.linalg.norm(turn) > 0:
        raise ValueError(f"the quaternion {list(quaternion)} has no direction")
    return motions.motion(motions.from_xyzw(turn), place)


def _from_conf(number: int, cells: list[str]) -> tuple[str, np.ndarray]:
    *place, x, y, z, w = _numbers(number, cells[2:], (7,))
    # The repository's programs use the inverse of the rotation that the quaternion means elsewhere.
    return cells[1], _pose(place, (-x, -y, -z, w))


def _from_colmap(number: int, cells: list[str]) -> tuple[str, np.ndarray]:
    w, x, y, z, *place = _numbers(number, cells[1:8], (7,))
    return cells[9], motions.inverse(_pose(place, (x, y, z, w)))


def _place(pose: Float[np.ndarray, "4 4"]) -> list[float]:
    return [*pose[:3, 3].tolist(), *motions.to_xyzw(pose[:3, :3]).tolist()]


def _colmap(index: int, name: str, pose: Float[np.ndarray, "4 4"]) -> tuple[str, str]:
    *place, x, y, z, w = _place(motions.inverse(pose))
    return f"{index + 1} {_row(w, x, y, z, *place)} 1 {name}", ""


def _conf(name: str, pose: Float[np.ndarray, "4 4"]) -> str:
    *place, x, y, z, w = _place(pose)
    return f"bmesh {name} {_row(*place, -x, -y, -z, w)}"


def _row(*values: float) -> str:
    return " ".join(f"{value:.17g}" for value in values)
