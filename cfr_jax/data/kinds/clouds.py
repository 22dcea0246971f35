"""A folder of point clouds, in any formats that `cfr_jax.io` reads."""

from __future__ import annotations

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
    """By the suffixes of the files below it, and the headers of those that may have faces."""
    return in_words("point clouds", count_loose(path, formats.of_clouds(), surfaces=False))


def unlikely(path: Path) -> bool:
    """Whether there are more meshes: a readme.txt beside them is no cloud."""
    clouds = count_loose(path, formats.of_clouds(), surfaces=False)
    return meshes.count(path).total() > clouds.total()


def train(path: str | Path, cache: Path) -> SceneSource:
    """Two views of one cloud each: nobody has to know how clouds lie to each other."""
    import numpy as np

    from cfr_jax import io
    from cfr_jax.data.pairs import Pair
    from cfr_jax.data.scenes import scene_source

    folder = Path(path)
    if not folder.is_dir():
        raise ValueError(f"no folder of scans at {folder}")
    files = list_scans(folder)

    def read(row: int) -> Pair:
        scan = io.read(files[row])
        clouds = scan.points, scan.points, scan.normals, scan.normals
        return Pair(files[row].name, *clouds, transform=np.eye(4))

    return scene_source(
        path,
        names=[file.relative_to(folder).as_posix() for file in files],
        frames=[((str(file.resolve()),),) for file in files],
        read=read,
        files=files,
        single=True,
    )


def list_scans(path: Path) -> list[Path]:
    """Every file below the folder in a format of clouds, but for hidden ones."""
    return loose_files(path, formats.of_clouds())


KIND = DataKind(
    name="clouds",
    words="a folder of point clouds",
    recognize=recognize,
    unlikely=unlikely,
    train=train,
    list_scans=list_scans,
)
