"""All columns of a file, in its order and types: a cloud is made of them, and written with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Real

from cfr_jax.io.cloud import PointCloud, as_float64, usable_normals
from cfr_jax.io.mesh import Mesh, Polygons, fan_triangles
from cfr_jax.io.naming import Roles, renamed, roles_of
from cfr_jax.io.unnamed import roles_of_unnamed

# Of the cloud's extent; no scanner is as precise.
_LARGEST_ROUNDING = 1e-5
_ROWS_AT_ONCE = 1 << 16


@dataclass(frozen=True, eq=False)
class Table:
    """Columns by position. Each has a name and one value, or a row of values, for every point.

    Attributes:
        names: of the columns; `named` tells whether they come from the file.
        values: arrays (n,) or (n, k), of the file's own types.
        roles: which columns are points and normals.
        polygons: the faces between the rows, if the file has any.
        rest: what only this format can write again: other elements, headers, arrays.
        format: the name of the format that this comes from.
    """

    names: tuple[str, ...]
    values: tuple[np.ndarray, ...]
    roles: Roles
    named: bool = True
    polygons: Polygons | None = None
    rest: Any = None
    format: str = ""

    @property
    def is_bare(self) -> bool:
        """Whether there is nothing but points and normals, in this order."""
        roles = (*self.roles.points, *self.roles.normals)
        return roles == tuple(range(len(self.values)))

    def points(self) -> Float64[np.ndarray, "n 3"]:
        """x, y, z of all rows, also of those that hold no point."""
        return self._stacked(self.roles.points)

    def normals(self) -> Float64[np.ndarray, "n 3"] | None:
        """The normals of all rows, of the length they have in the file."""
        return self._stacked(self.roles.normals) if self.roles.normals else None

    def _stacked(self, columns: Sequence[int]) -> Float64[np.ndarray, "n 3"]:
        if len(columns) == 1:  # one column of three numbers
            return as_float64(self.values[columns[0]])
        stacked = np.empty((len(self.values[columns[0]]), 3))
        with np.errstate(invalid="ignore"):  # signaling NaNs, which damaged files hold, would warn
            for axis, column in enumerate(columns):
                stacked[:, axis] = self.values[column]
        return stacked

    def moved(
        self, points: Float64[np.ndarray, "n 3"], normals: Float64[np.ndarray, "n 3"] | None
    ) -> Table:
        """The same table with other points and normals, as `points` and `normals` give them.

        They get the type that they had, or float64 where that would deform the cloud.
        """
        values = list(self.values)
        before = self.points()
        for columns, old, new in (
            (self.roles.points, before, points),
            (self.roles.normals, None, normals),
        ):
            if new is None:
                continue
            for axis, column in enumerate(columns):
                part = new if len(columns) == 1 else new[:, axis]
                kind = values[column].dtype
                fits = kind.kind == "f" and (old is None or not _deforms(new, old, kind))
                values[column] = part.astype(kind.newbyteorder("=") if fits else np.float64)
        return replace(self, values=tuple(values))

    def shape(self, name: str, notes: tuple[str, ...], whole: bool) -> PointCloud | Mesh:
        """The surface if the table has faces, else the cloud of the rows that hold a point.

        It keeps the table if it is to be `whole`.
        """
        kept = self if whole else None
        points, normals = self.points(), self.normals()
        if self.polygons is not None:
            if normals is not None:
                normals = usable_normals(normals) if len(normals) else None
            triangles = fan_triangles(*self.polygons)
            return Mesh(points, triangles, name, normals, notes, kept)
        return cloud_of_filled(points, normals, name, notes, kept)


def table_of(
    names: Sequence[str],
    values: Sequence[np.ndarray],
    columns: Sequence[str] | None = None,
    *,
    polygons: Polygons | None = None,
    rest: Any = None,
    format: str = "",
) -> Table:
    """A table of named columns; `columns` are other names that the user gave."""
    names = renamed(names, columns)
    return Table(tuple(names), tuple(values), roles_of(names), True, polygons, rest, format)


def unnamed_table(
    values: Sequence[np.ndarray], columns: Sequence[str] | None = None, *, format: str = ""
) -> tuple[Table, tuple[str, ...]]:
    """A table of columns without names unless the user gave some, and notes on what it means."""
    names = [f"column_{k + 1}" for k in range(len(values))]
    if columns is not None:
        names = renamed(names, columns)
        return Table(tuple(names), tuple(values), roles_of(names), False, format=format), ()
    roles, notes = roles_of_unnamed(values)
    return Table(tuple(names), tuple(values), roles, False, format=format), notes


def plain_table(cloud: PointCloud) -> Table:
    """The table of a cloud that is only points and perhaps normals."""
    if cloud.normals is None:
        return Table(("x", "y", "z"), tuple(cloud.points.T), Roles((0, 1, 2)), False)
    values = np.hstack([cloud.points, cloud.normals]).T
    names = ("x", "y", "z", "nx", "ny", "nz")
    return Table(names, tuple(values), Roles((0, 1, 2), (3, 4, 5)), False)


def table_of_mesh(mesh: Mesh) -> Table:
    """The vertices and triangles of a mesh."""
    vertices = np.asarray(mesh.vertices)
    names, values, roles = ("x", "y", "z"), tuple(vertices.T), Roles((0, 1, 2))
    count = len(mesh.triangles)
    sizes = np.broadcast_to(np.uint8(3), count)
    polygons = np.asarray(mesh.triangles), sizes
    return Table(names, values, roles, True, polygons if count else None)


def cloud_of_filled(
    points: np.ndarray,
    normals: np.ndarray | None,
    name: str,
    notes: tuple[str, ...] = (),
    table: Table | None = None,
) -> PointCloud:
    """The rows that hold a point, with their normals if all are usable.

    Rows with NaN or infinity in x, y or z are cells without a point: they are left out, and counted
    in `left_out`. Raises ValueError where no row is left.
    """
    filled = finite_rows(points)
    left_out = len(points) - int(np.count_nonzero(filled))
    if left_out and left_out == len(points):
        raise ValueError(
            f"all {left_out} points are NaN or infinite, wanted at least one that is not"
        )
    if left_out:
        own = table is None  # its columns may be views of the points
        points = _kept(points, filled, own)
        normals = None if normals is None else _kept(normals, filled, own)
    usable = None if normals is None or not len(points) else usable_normals(normals)
    return PointCloud(points, usable, name, left_out, notes, table)


def finite_rows(points: Real[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Which rows hold numbers in all of their columns."""
    filled = np.isfinite(points[:, 0])
    for column in points.T[1:]:
        filled &= np.isfinite(column)
    return filled


def _kept(rows: np.ndarray, chosen: Bool[np.ndarray, " n"], own: bool) -> np.ndarray:
    """The chosen rows: moved together within their own memory where that is free to use."""
    if not own or not rows.flags.writeable:
        return rows[chosen]
    done = 0
    for start in range(0, len(rows), _ROWS_AT_ONCE):
        part = rows[start : start + _ROWS_AT_ONCE][chosen[start : start + _ROWS_AT_ONCE]]
        rows[done : done + len(part)] = part
        done += len(part)
    return rows[:done]


def rounding(points: Float64[np.ndarray, "n 3"], kind: np.dtype) -> float:
    """How far the type moves points, as a share of the cloud's extent."""
    kept = points[np.isfinite(points).all(axis=1)]
    if len(kept) == 0:
        return 0.0
    extent = float(np.linalg.norm(np.ptp(kept, axis=0)))
    largest = float(np.abs(kept).max())
    if largest > float(np.finfo(kind).max):
        return np.inf
    moved = largest * float(np.finfo(kind).eps) / 2
    return moved / extent if extent > 0 else 0.0


def deforms(points: Float64[np.ndarray, "n 3"], kind: np.dtype) -> bool:
    """Whether a float type is too coarse for these points, for the extent they have."""
    return rounding(points, kind) > _LARGEST_ROUNDING


def _deforms(new: np.ndarray, old: np.ndarray, kind: np.dtype) -> bool:
    # What was as coarse before is not made worse.
    return deforms(new, kind) and rounding(new, kind) > 2 * rounding(old, kind)


def without_faces(cloud: PointCloud, form: str) -> tuple[Table, list[str]]:
    """What a format without faces writes of a cloud, and a note if faces are lost.

    Of a surface these are the points drawn from it: its bare vertices may be few.
    """
    table = cloud.table
    if table is None:
        return plain_table(cloud), []
    if table.polygons is not None and len(table.polygons[1]):
        note = f"{form} holds no faces: wrote {len(cloud)} points drawn from them; .ply holds both"
        return plain_table(cloud), [note]
    return table, []
