"""XYZ, TXT, ASC and CSV: a point on each line, in any of the ways that programs write tables."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from cfr_jax.io.cloud import CloudFileError, PointCloud
from cfr_jax.io.formats.text.body import read_columns, read_numbers
from cfr_jax.io.formats.text.dialect import Layout, decoded, layout_of
from cfr_jax.io.mesh import Mesh
from cfr_jax.io.naming import Roles, renamed, roles_of
from cfr_jax.io.table import Table, unnamed_table
from cfr_jax.io.unnamed import roles_of_unnamed

FORMAT = "text"
_XYZN = ("x", "y", "z", "nx", "ny", "nz")
_XYZRGB = ("x", "y", "z", "r", "g", "b")


def parse(
    data: bytes, name: str, *, columns: tuple[str, ...] | None = None, whole: bool = False
) -> PointCloud | Mesh:
    """Points with the columns that the names say, or `unnamed.roles_of_unnamed` without names.

    Names stand in a line of their own, or in a comment above the points. Numbers are separated by
    blanks, commas or semicolons, and comments begin with `#`, `//` or `%`. Also understood: a count
    of the points in front, a line `sep=;`, decimal commas, quotes, a delimiter at the end of rows,
    an index without a name, a byte order mark, and UTF-16. Columns other than points and normals
    need not be numbers if they have names.
    """
    text = decoded(data)
    return parsed(text, layout_of(text, columns), name, columns, whole)


def parse_xyzn(
    data: bytes, name: str, *, columns: tuple[str, ...] | None = None, whole: bool = False
) -> PointCloud | Mesh:
    """x y z and the normal, without names."""
    return _fixed(data, name, columns, whole, _XYZN)


def parse_xyzrgb(
    data: bytes, name: str, *, columns: tuple[str, ...] | None = None, whole: bool = False
) -> PointCloud | Mesh:
    """x y z and a color, without names."""
    return _fixed(data, name, columns, whole, _XYZRGB)


def _fixed(
    data: bytes, name: str, columns: tuple[str, ...] | None, whole: bool, usual: tuple[str, ...]
) -> PointCloud | Mesh:
    text = decoded(data)
    layout = layout_of(text, columns)
    if columns is None and layout.names is None and layout.width == len(usual):
        columns = usual
    return parsed(text, layout, name, columns, whole)


def parsed(
    text: bytes, layout: Layout, name: str, columns: tuple[str, ...] | None, whole: bool
) -> PointCloud | Mesh:
    """The cloud of a text whose layout is known."""
    names = layout.names
    if columns is not None:
        names = tuple(renamed([""] * layout.width, columns))
    if layout.width < 3:
        raise CloudFileError(
            f"line {layout.line}: wanted rows of x, y, z and perhaps more, got {layout.width} "
            "numbers"
        )
    if whole:
        table, notes = _whole(text, layout, names, columns is None)
    elif names is not None:
        roles = roles_of(names)
        chosen = (*roles.points, *roles.normals)
        numbers = read_numbers(text, layout, chosen)
        table, notes = _bare(numbers, bool(roles.normals)), ()
    else:
        first = layout.skipped
        seen = 6 if layout.width - first == 6 else min(layout.width - first, 4)
        chosen = tuple(range(first, first + seen))
        all_of_them = layout.width == seen and not layout.quoted
        numbers = read_numbers(text, layout, None if all_of_them else chosen)
        roles, notes = _judged(list(numbers.T), layout.width - first)
        table = _bare(numbers, bool(roles.normals))
    count = len(table.values[0])
    if layout.count is not None and count != layout.count:
        raise CloudFileError(f"says in front that it has {layout.count} points, holds {count}")
    return table.shape(name, layout.notes + notes, whole)


def _whole(
    text: bytes, layout: Layout, names: tuple[str, ...] | None, named: bool
) -> tuple[Table, tuple[str, ...]]:
    """The table with every column."""
    if names is not None:
        roles = roles_of(names)
        values = read_columns(text, layout, (*roles.points, *roles.normals))
        return Table(names, tuple(values), roles, named, format=FORMAT), ()
    first = layout.skipped
    values = read_columns(text, layout, range(first, first + 6))
    return unnamed_table(values[first:], format=FORMAT)


def _judged(values: list, width: int) -> tuple[Roles, tuple[str, ...]]:
    """The roles in a table whose first columns alone were read."""
    return roles_of_unnamed([*values, *values[:1] * (width - len(values))])


def _bare(numbers: Float64[np.ndarray, "n c"], normals: bool) -> Table:
    """Points, and perhaps normals, that stand side by side; they are not copied."""
    if not normals:
        return Table(("points",), (numbers[:, :3],), Roles((0,)))
    return Table(("points", "normals"), (numbers[:, :3], numbers[:, 3:6]), Roles((0,), (1,)))
