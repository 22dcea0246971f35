"""NPZ: a zip archive of arrays."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from cfr_jax.io.budget import POINT, check_room
from cfr_jax.io.cloud import CloudFileError, PointCloud
from cfr_jax.io.formats.arrays.npy import read_array, table_of_array
from cfr_jax.io.mesh import Mesh
from cfr_jax.io.naming import Roles, are_names, roles_of
from cfr_jax.io.table import Table

_POINTS = (
    "points",
    "xyz",
    "pc",
    "pcd",
    "pointcloud",
    "point_cloud",
    "pts",
    "vertices",
    "positions",
)
_PAIRED = ("src", "ref", "source", "target", "tgt")
_NORMALS = ("normals", "normal")


def parse(
    data: bytes,
    name: str,
    *,
    columns: tuple[str, ...] | None = None,
    whole: bool = False,
    member: str | None = None,
) -> PointCloud | Mesh:
    """The array that is called `points`, `xyz`, `pc`, `pcd` or the like, or the only one.

    Beside it `normals`, if there are any. Arrays x, y, z of equal length are a cloud, too. Several
    clouds in one archive, as `src` and `ref`, are refused unless `member` names one: nothing else
    says which one is meant.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {
                info.filename.removesuffix(".npy"): info
                for info in archive.infolist()
                if not info.is_dir()
            }
            arrays = _Arrays(archive, members, len(data))
            table, notes = _table(arrays, columns, member)
            if whole:
                table = _with_all(table, arrays)
    except CloudFileError:
        raise
    except ValueError as error:
        raise CloudFileError(str(error)) from None
    except Exception as error:  # zipfile and the codecs below it raise what they like
        raise CloudFileError(
            f"wanted a zip archive of arrays: {type(error).__name__}: {error}"
        ) from None
    return table.shape(name, notes, whole)


class _Arrays:
    """The members of an archive, unpacked when asked for."""

    def __init__(
        self, archive: zipfile.ZipFile, members: dict[str, zipfile.ZipInfo], size: int
    ) -> None:
        self._archive, self.members, self.size = archive, members, size
        self.taken = 0

    def __getitem__(self, key: str) -> np.ndarray:
        info = self.members[key]
        self.taken += info.file_size
        check_room(self.taken, 1, self.size, f"bytes with {info.filename!r:.60} unfolded")
        with self._archive.open(info) as stream:
            data = stream.read(info.file_size)
        try:
            return read_array(data)
        except CloudFileError as error:
            raise CloudFileError(f"{info.filename!r}: {error}") from None

    def called(self, wanted: Iterable[str]) -> list[str]:
        """The members with one of these names, in any case."""
        return [key for key in self.members if key.lower() in wanted]


def _table(
    arrays: _Arrays, columns: tuple[str, ...] | None, member: str | None
) -> tuple[Table, tuple[str, ...]]:
    names = list(arrays.members)
    found = arrays.called(_POINTS) or arrays.called(_PAIRED)
    if member is not None:
        if member not in names:
            held = ", ".join(map(repr, sorted(names)[:8])) or "nothing"
            raise CloudFileError(f"has no array {member!r:.60}, wanted one of {held}")
        found = [member]
    elif not found and are_names(names):
        roles = roles_of(names)
        chosen = [names[k] for k in (*roles.points, *roles.normals)]
        values = [arrays[key] for key in chosen]
        check_room(len(values[0]), 3 * POINT, arrays.size, "points", arrays.taken)
        if any(v.ndim != 1 or v.shape != values[0].shape for v in values):
            raise CloudFileError(f"arrays {', '.join(chosen)}: wanted one axis of equal length")
        inner = Roles((0, 1, 2), (3, 4, 5) if roles.normals else ())
        return Table(tuple(chosen), tuple(values), inner, format="NPZ"), ()
    if len(found) != 1 and len(names) != 1:
        held = ", ".join(map(repr, sorted(names)[:8])) or "nothing"
        choose = f"; FILE.npz:{found[0]:.40} names one" if found else "; FILE.npz:NAME names one"
        raise CloudFileError(
            f"wanted an array 'points' (or 'xyz', 'pc', 'pcd'), or a single one, got {held}{choose}"
        )
    key = found[0] if found else names[0]
    array = arrays[key]
    beside = arrays.called(_NORMALS) if member is None else []
    if len(beside) == 1 and not array.dtype.names and columns is None:
        flat = array.reshape(-1, array.shape[-1])
        check_room(len(flat), 3 * POINT, arrays.size, "points with normals", arrays.taken)
        normals = arrays[beside[0]]
        normals = normals.reshape(-1, normals.shape[-1])
        if flat.shape[1] == 3 and normals.shape == flat.shape:
            table = Table((key, beside[0]), (flat, normals), Roles((0,), (1,)), format="NPZ")
            return table, ()
        raise CloudFileError(
            f"{key!r} is {array.shape} and {beside[0]!r} {normals.shape}, wanted (n, 3) of both"
        )
    table, notes = table_of_array(array, columns, arrays.size, arrays.taken)
    if not array.dtype.names and array.shape[-1] == 3:
        flat = array.reshape(-1, 3)
        return Table((key,), (flat,), Roles((0,)), format="NPZ"), notes
    return table, notes


def _with_all(table: Table, arrays: _Arrays) -> Table:
    """The table with every other array: a column where it has the table's length."""
    rows = len(table.values[0])
    names, values = list(table.names), list(table.values)
    rest: dict[str, np.ndarray] = {}
    for key in arrays.members:
        if key in names:
            continue
        array = arrays[key]
        if array.ndim in (1, 2) and len(array) == rows and array.dtype.names is None:
            names.append(key)
            values.append(array)
        else:
            rest[key] = array
    return replace(table, names=tuple(names), values=tuple(values), rest=rest)
