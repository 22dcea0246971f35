"""`read` and `write`: from a path to a cloud and back.

The formats come from the table `cfr_jax.io.formats`. Files are opened by `runtime.reading`.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from cfr_jax.io import formats
from cfr_jax.io.cloud import CloudFileError, CloudWarning, PointCloud
from cfr_jax.io.formats import Format
from cfr_jax.io.mesh import Mesh
from cfr_jax.io.naming import checked_columns
from cfr_jax.io.table import table_of_mesh
from cfr_jax.runtime import reading
from cfr_jax.runtime.atomic import unfinished
from cfr_jax.runtime.messages import Refused, shown


def read(
    path: str | os.PathLike[str],
    *,
    samples: int | None = None,
    seed: int = 0,
    columns: str | Iterable[str] | None = None,
    properties: bool = False,
) -> PointCloud:
    """The points of a file. The suffix tells its format.

    A file with faces is a surface, from which points are drawn uniformly by area; their normals are
    those of the faces. All other files are clouds and are read as they are, with their normals if
    all of these are usable. Rows whose x, y or z is NaN or infinite hold no point; they are left
    out and counted in `left_out`. Coordinates keep the file's unit and frame.

    Columns are found by their names, in every format that has names. Columns without names are
    checked, and a `CloudWarning` says what was taken for what, unless they are just x, y, z, or
    x, y, z and unit vectors.

    Args:
        path: a file of any format that `cfr register --help` lists. "pair.npz:src" is the array
            `src` of an archive that holds several clouds.
        samples: points to draw from a surface: 10,000 if None; 0 takes the vertices of the mesh
            instead. A cloud has no surface, so this does not thin it.
        seed: of the drawing; the same seed gives the same points.
        columns: the names of the file's columns in their order, as "x,y,z,intensity" or a list:
            for files without names or with misleading ones. x, y, z must be among them; nx, ny, nz
            are normals, and all other names are free.
        properties: whether the cloud keeps all other columns, and the faces, in `table`, so that
            `write` can write them again.

    Raises:
        CloudFileError: the file is missing, damaged, empty, or not of its format, or its columns
            are ambiguous; the message names the file, the place in it, and what was wanted.
        ValueError: `samples` is negative, or `columns` does not name x, y and z once each.
    """
    if samples is not None and samples < 0:
        raise ValueError(f"samples must be 0 or more, got {samples}")
    named = checked_columns(columns)
    shape = read_shape(path, formats.entries(), columns=named, whole=properties)
    if properties and isinstance(shape, Mesh) and shape.table is None:
        shape = replace(shape, table=table_of_mesh(shape))
    try:
        cloud = shape.points(samples, seed) if isinstance(shape, Mesh) else shape
    except ValueError as error:
        raise CloudFileError(f"{shown(path)}: {error}") from None
    for note in cloud.notes:
        warnings.warn(CloudWarning(path, note), stacklevel=2)
    return cloud


def read_shape(
    path: str | os.PathLike[str],
    known: Iterable[Format],
    *,
    columns: tuple[str, ...] | None = None,
    whole: bool = False,
) -> PointCloud | Mesh:
    """What a file of one of the `known` formats holds; a surface is not sampled yet.

    `columns` and `whole` are the `columns` and `properties` of `read`. Raises CloudFileError as
    `read` does.
    """
    path, member = _member_of(Path(path))
    try:
        if os.path.isdir(path):
            raise CloudFileError("is a folder, wanted a file")
        form = _chosen(known, path.suffix)
        if columns is not None and not form.has_columns:
            raise CloudFileError(f"columns: {form.name} files say themselves what they hold")
        place = (path.parent,) if form.needs_folder else ()
        options: dict[str, Any] = {}
        if form.has_columns:
            options = {"columns": columns, "whole": whole}
        if member is not None:
            options["member"] = member
        held = form.parse(contents(path), path.name, *place, **options)
    except ValueError as error:
        raise CloudFileError(f"{shown(path)}: {error}") from None
    if not isinstance(held, PointCloud | Mesh):  # a format from outside may give anything
        raise TypeError(
            f"parse: that of the format {form.name!r} returned a {type(held).__name__}, wanted a "
            "PointCloud or a Mesh (`Table.shape` makes one)"
        )
    return held


def _member_of(path: Path) -> tuple[Path, str | None]:
    """A file, and the array that its name asks for: "pair.npz:src" is `src` of pair.npz."""
    archive, colon, member = path.name.rpartition(":")
    if colon and archive.lower().endswith(".npz") and not path.exists():
        return path.with_name(archive), member
    return path, None


def write(path: str | os.PathLike[str], cloud: PointCloud) -> None:
    """Writes a cloud; an older file of that name is replaced only once all is written.

    The suffix chooses the format, one of those that `cfr register --help` lists for `--out`. A
    cloud that was read with `properties=True` is written with all its columns in their order and
    types, and in PLY with its faces; a `CloudWarning` names what the format cannot hold. Any other
    cloud is points and normals: PLY is then binary in double precision, PCD binary in single; NPY
    holds (n, 3) or (n, 6), and NPZ the arrays `points` and `normals`.

    Raises:
        CloudFileError: the suffix is none of these, the folder cannot be written to, or the cloud
            lies so far from its origin that the float32 of PCD would deform it.
    """
    path = Path(path)
    try:
        save = _chosen(formats.writable(), path.suffix).save
        assert save is not None  # that is what writable means
        with unfinished(path) as beside, open(beside, "xb") as stream:
            notes = save(stream, cloud)
    except OSError as error:
        raise CloudFileError(f"{shown(path)}: cannot be written: {error.strerror}") from None
    except ValueError as error:
        raise CloudFileError(f"{shown(path)}: {error}") from None
    for note in notes or ():
        warnings.warn(CloudWarning(path, note), stacklevel=2)


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
