"""`read` and `write`: from a path to a cloud and back.

The formats come from the table `cfr_jax.io.formats`. Files are opened by `runtime.reading`.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from cfr_jax.io import formats
from cfr_jax.io.cloud import CloudFileError, PointCloud
from cfr_jax.io.formats import Format
from cfr_jax.io.mesh import Mesh
from cfr_jax.runtime import reading
from cfr_jax.runtime.atomic import unfinished
from cfr_jax.runtime.words import Refused, shown


def read(path: str | os.PathLike[str], *, samples: int | None = None, seed: int = 0) -> PointCloud:
    """The points of a file, its format told by the suffix.

    A file with faces is a surface and is sampled uniformly by area; the normals are then those
    of the faces. All others are clouds, read as they are, with their normals if all are usable.
    Coordinates keep the file's unit and frame.

    Args:
        path: a file of any format that `cfr register --help` lists.
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
    shape = read_shape(path, formats.known())
    try:
        return shape.points(samples, seed) if isinstance(shape, Mesh) else shape
    except ValueError as error:
        raise CloudFileError(f"{shown(path)}: {error}") from None


def read_shape(path: str | os.PathLike[str], known: Iterable[Format]) -> PointCloud | Mesh:
    """What a file of one of the `known` formats holds; a surface is not sampled yet.

    Raises CloudFileError as `read` does.
    """
    path = Path(path)
    try:
        if os.path.isdir(path):
            raise CloudFileError("is a folder, wanted a file")
        form = _chosen(known, path.suffix)
        place = (path.parent,) if form.needs_folder else ()
        return form.parse(contents(path), path.name, *place)
    except ValueError as error:
        raise CloudFileError(f"{shown(path)}: {error}") from None


def write(path: str | os.PathLike[str], cloud: PointCloud) -> None:
    """Writes points and normals; a file of that name is replaced only once all is written.

    The suffix chooses the format, one of those that `cfr register --help` lists for `--out`. PLY is
    binary in double precision, PCD binary in single; NPY holds (n, 3) or (n, 6), NPZ the arrays
    `points` and `normals`.

    Raises:
        CloudFileError: the suffix is none of these, the folder cannot be written to, or the
            cloud lies so far from its origin that PCD's float32 would deform it.
    """
    path = Path(path)
    try:
        save = _chosen(formats.writable(), path.suffix).save
        assert save is not None  # that is what writable means
        with unfinished(path) as beside, open(beside, "xb") as stream:
            save(stream, cloud)
    except OSError as error:
        raise CloudFileError(f"{shown(path)}: cannot be written: {error.strerror}") from None
    except ValueError as error:
        raise CloudFileError(f"{shown(path)}: {error}") from None


def contents(path: Path) -> bytes:
    """All bytes of a file that a user names; raises CloudFileError, without the path, where there
    are none or where reading might never end."""
    try:
        return reading.contents(path)
    except Refused as error:
        raise CloudFileError(error) from None


def _chosen(known: Iterable[Format], suffix: str) -> Format:
    held = formats.by_suffix(known)
    if suffix.lower() not in held:
        raise CloudFileError(f"unknown suffix {suffix.lower()!r}, wanted one of {' '.join(held)}")
    return held[suffix.lower()]
