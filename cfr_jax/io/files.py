"""`read` and `write`: from a path to a cloud and back."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from cfr_jax.io.cloud import CloudFileError, PointCloud
from cfr_jax.io.formats import arrays, gltf, las, pcd, ply, surfaces, text
from cfr_jax.io.mesh import Mesh
from cfr_jax.runtime.atomic import unfinished

_READERS: dict[str, Callable[..., PointCloud | Mesh]] = {
    ".ply": ply.parse,
    ".pcd": pcd.parse,
    ".xyz": text.parse,
    ".txt": text.parse,
    ".csv": text.parse,
    ".npy": arrays.parse_npy,
    ".npz": arrays.parse_npz,
    ".bin": arrays.parse_velodyne,
    ".las": las.parse,
    ".laz": las.parse,
    ".off": surfaces.parse_off,
    ".obj": surfaces.parse_obj,
    ".stl": surfaces.parse_stl,
    ".glb": gltf.parse_glb,
    ".gltf": gltf.parse_gltf,
}
SUFFIXES = tuple(_READERS)
_WRITERS: dict[str, Callable[[BinaryIO, PointCloud], None]] = {
    ".ply": ply.save,
    ".pcd": pcd.save,
    ".xyz": text.save,
    ".txt": text.save,
    ".npy": arrays.save_npy,
    ".npz": arrays.save_npz,
}
# Documents that name other files, and so have to know where they lie.
_NEEDS_FOLDER = (".glb", ".gltf")


def read(path: str | os.PathLike[str], *, samples: int | None = None, seed: int = 0) -> PointCloud:
    """The points of a file, its format told by the suffix.

    A file with faces is a surface and is sampled uniformly by area; the normals are then those
    of the faces. All others are clouds, read as they are, with their normals if all are usable.
    Coordinates keep the file's unit and frame.

    Args:
        path: `.ply`, `.pcd`, `.xyz`, `.txt`, `.csv`, `.npy`, `.npz`, `.bin` (KITTI), `.las`,
            `.laz` (needs the `io` extra), `.off`, `.obj`, `.stl`, `.glb` or `.gltf`.
        samples: points to draw from a surface: 10,000 if None; 0 takes the mesh's vertices
            instead. A cloud has no surface, and is not thinned by this.
        seed: of the sampling; the same seed gives the same points.

    Raises:
        CloudFileError: the file is missing, damaged, empty, or not of its format; the message
            names the file, the place in it, and what was wanted.
        ValueError: `samples` is negative.
    """
    if samples is not None and samples < 0:
        raise ValueError(f"samples must be 0 or more, got {samples}")
    path = Path(path)
    suffix = path.suffix.lower()
    try:
        if path.is_dir():
            raise CloudFileError("is a folder, wanted a file")
        parse = _chosen(_READERS, suffix)
        data = _contents(path)
        place = (path.parent,) if suffix in _NEEDS_FOLDER else ()
        shape = parse(data, path.name, *place)
        return shape.points(samples, seed) if isinstance(shape, Mesh) else shape
    except ValueError as error:
        raise CloudFileError(f"{path}: {error}") from None


def write(path: str | os.PathLike[str], cloud: PointCloud) -> None:
    """Writes points and normals; a file of that name is replaced only once all is written.

    The suffix chooses: `.ply` (binary, double), `.pcd` (binary, float), `.xyz` and `.txt`
    (text), `.npy` ((n, 3) or (n, 6)), `.npz` (`points`, `normals`).

    Raises:
        CloudFileError: the suffix is none of these, the folder cannot be written to, or the
            cloud lies so far from its origin that PCD's float32 would deform it.
    """
    path = Path(path)
    try:
        save = _chosen(_WRITERS, path.suffix.lower())
        with unfinished(path) as beside, open(beside, "xb") as stream:
            save(stream, cloud)
    except OSError as error:
        raise CloudFileError(f"{path}: cannot be written: {error.strerror}") from None
    except CloudFileError as error:
        raise CloudFileError(f"{path}: {error}") from None


def _chosen(formats: dict[str, Callable], suffix: str) -> Callable:
    if suffix not in formats:
        raise CloudFileError(f"unknown suffix {suffix!r}, wanted one of {' '.join(formats)}")
    return formats[suffix]


def _contents(path: Path) -> bytes:
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):  # reading a pipe or a device may never end
            raise CloudFileError("is not a regular file")
        data = path.read_bytes()
    except OSError as error:
        raise CloudFileError(f"cannot be read: {error.strerror}") from None
    if not data:
        raise CloudFileError("is empty")
    return data
