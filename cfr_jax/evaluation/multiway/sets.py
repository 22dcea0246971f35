"""Sets of scans with known poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from cfr_jax.data.folders import loose_files
from cfr_jax.io import formats, read
from cfr_jax.multiway.pose_files import read_poses


@dataclass(frozen=True, eq=False)
class ScanSet:
    """Scans of one thing; `poses` map each into one frame."""

    name: str
    files: tuple[Path, ...]
    poses: Float[np.ndarray, "n 4 4"]

    def centers(self) -> Float[np.ndarray, "n 3"]:
        """The centroid of each scan, in its own frame: where translations are compared."""
        return np.stack([read(file).points.mean(axis=0) for file in self.files])


def read_sets(data: Mapping[str, Any], limit: int) -> list[ScanSet]:
    """The sets that `MergeConfig.data` names. Raises ValueError where there are none."""
    path = Path(data["path"])
    if data["kind"] == "kitti":
        sequence = str(data.get("sequence", "00"))
        files = sorted((path / "sequences" / sequence / "velodyne").glob("*.bin"))
        files = files[: limit or None]
        if len(files) < 2:
            raise ValueError(f"data: {path} has {len(files)} frames in sequence {sequence}")
        table = np.loadtxt(path / "poses" / f"{sequence}.txt").reshape(-1, 3, 4)[: len(files)]
        poses = np.tile(np.eye(4), (len(table), 1, 1))
        poses[:, :3] = table
        return [ScanSet(f"sequence {sequence}", tuple(files), poses)]
    folders = sorted(file.parent for file in path.glob("*/poses.json"))[: limit or None]
    if not folders:
        raise ValueError(f"data: {path} has no folder with a poses.json")
    return [_of_folder(folder) for folder in folders]


def _of_folder(folder: Path) -> ScanSet:
    files = loose_files(folder, formats.of_clouds())
    held = read_poses(folder / "poses.json", [file.name for file in files])
    known = [file for file in files if file.name in held]
    return ScanSet(folder.name, tuple(known), np.stack([held[file.name] for file in known]))
