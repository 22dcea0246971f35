"""A folder of point clouds, in any format that `cfr_jax.io` reads."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING

from cfr_jax.data.folders import count_loose, in_words, loose_files
from cfr_jax.data.kinds import meshes
from cfr_jax.data.kinds.kind import DataKind
from cfr_jax.io import formats

if TYPE_CHECKING:
    from cfr_jax.data.pairs import Pair
    from cfr_jax.data.scenes import SceneSource


def recognize(path: Path) -> str | None:
    """Looks at the suffixes of all files in the folder, and at the headers of those that may have
    faces."""
    return in_words("point clouds", count_loose(path, formats.of_clouds(), surfaces=False))


def unlikely(path: Path) -> bool:
    """Whether there are more meshes than clouds: a readme.txt beside meshes is not a cloud."""
    clouds = count_loose(path, formats.of_clouds(), surfaces=False)
    return meshes.count(path).total() > clouds.total()


def train(path: str | Path, cache: Path) -> SceneSource:
    """Pairs of two views of one cloud, which need no known motion between clouds."""
    from cfr_jax.data.scenes import scene_source

    folder = Path(path)
    if not folder.is_dir():
        raise ValueError(f"path: there is no folder of scans at {folder}")
    files = list_scans(folder)

    return scene_source(
        path,
        names=[file.relative_to(folder).as_posix() for file in files],
        frames=[((str(file.resolve()),),) for file in files],
        read=functools.partial(_read, files),
        files=files,
        single=True,
    )


def _read(files: list[Path], row: int) -> Pair:
    import numpy as np

    from cfr_jax import io
    from cfr_jax.data.pairs import Pair

    scan = io.read(files[row])
    clouds = scan.points, scan.points, scan.normals, scan.normals
    return Pair(files[row].name, *clouds, transform=np.eye(4))


def list_scans(path: Path) -> list[Path]:
    """All files in the folder and its subfolders in a format of clouds, except hidden ones."""
    return loose_files(path, formats.of_clouds())


KIND = DataKind(
    name="clouds",
    words="a folder of point clouds",
    recognize=recognize,
    unlikely=unlikely,
    train=train,
    list_scans=list_scans,
)
