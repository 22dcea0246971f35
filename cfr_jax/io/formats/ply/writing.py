"""Clouds and meshes as binary PLY."""

from __future__ import annotations

from typing import BinaryIO

import numpy as np
from jaxtyping import UInt8

from cfr_jax.io.cloud import PointCloud
from cfr_jax.io.formats.ply.elements import Element, Ragged
from cfr_jax.io.formats.ply.reading import FORMAT
from cfr_jax.io.table import Table, plain_table

_NAMES = {
    "i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint",
    "f4": "float", "f8": "double",
}  # fmt: skip
# What other programs' PLY does not know is written as a type that holds the same numbers.
_WIDER = {"b1": "u1", "f2": "f4"}
_EXACT = 1 << 53  # beyond, float64 does not hold every whole number

Column = tuple[str, "np.ndarray | Ragged"]


def save(stream: BinaryIO, cloud: PointCloud) -> list[str]:
    """Little-endian, with every property in its type; doubles for a bare cloud of points."""
    table = cloud.table if cloud.table is not None else plain_table(cloud)
    notes: list[str] = []
    if cloud.table is None:
        names = ("x", "y", "z", "nx", "ny", "nz")[: len(table.values)]
        _write(stream, [("vertex", list(zip(names, table.values, strict=True)))])
        return notes
    vertices = _vertices(table, notes)
    if table.format == FORMAT and table.rest is not None:
        _write(stream, _again(table, vertices))
        return notes
    elements = [("vertex", vertices)]
    if table.polygons is not None and len(table.polygons[1]):
        values, sizes = table.polygons
        kind = "u1" if sizes.max() < 256 else "i4"
        faces = Ragged(values.astype("<i4").ravel(), sizes.astype(kind))
        elements.append(("face", [("vertex_indices", faces)]))
    _write(stream, elements)
    return notes


def _again(table: Table, vertices: list[Column]) -> list[tuple[str, list[Column]]]:
    """All elements of a file in PLY, its vertices replaced."""
    elements: list[Element]
    elements, held, vertex = table.rest
    written: list[tuple[str, list[Column]]] = []
    for k, (element, columns) in enumerate(zip(elements, held, strict=True)):
        pairs = zip(element.properties, columns, strict=True)
        found = [(prop.name, column) for prop, column in pairs if column is not None]
        if k == vertex:
            moved = iter(vertices)
            # lists among the properties keep their places
            found = [pair if isinstance(pair[1], Ragged) else next(moved) for pair in found]
        written.append((element.name, found))
    return written


def _vertices(table: Table, notes: list[str]) -> list[Column]:
    """The columns of a table as PLY can hold them; what it cannot is told in a note."""
    columns: list[Column] = []
    lost = []
    for k, (name, values) in enumerate(zip(table.names, table.values, strict=True)):
        if k in table.roles.points and len(table.roles.points) == 1:
            parts = [(axis, values[:, i]) for i, axis in enumerate("xyz")]
        elif k in table.roles.normals and len(table.roles.normals) == 1:
            parts = [("n" + axis, values[:, i]) for i, axis in enumerate("xyz")]
        elif values.ndim > 1:
            parts = [(f"{name}_{i}", values[:, i]) for i in range(values.shape[1])]
        elif table.format != FORMAT and k in table.roles.points:
            parts = [("xyz"[table.roles.points.index(k)], values)]
        elif table.format != FORMAT and k in table.roles.normals:
            parts = [("n" + "xyz"[table.roles.normals.index(k)], values)]
        else:
            parts = [("_".join(name.split()) or f"column_{k + 1}", values)]
        for label, part in parts:
            held = _held(part)
            if held is None:
                lost.append(label)
            else:
                columns.append((label, held))
    if lost:
        notes.append(f"left out {', '.join(lost)}: PLY holds numbers up to 32 bits and doubles")
    return columns


def _held(values: np.ndarray) -> np.ndarray | None:
    """The same numbers in a type of PLY; None if it has none."""
    kind = values.dtype.kind + str(values.dtype.itemsize)
    if kind in _NAMES:
        return values
    if kind in _WIDER:
        return values.astype(_WIDER[kind])
    if values.dtype.kind in "iu":
        low, high = (int(values.min()), int(values.max())) if len(values) else (0, 0)
        for narrower in ("i4", "u4"):
            limits = np.iinfo(narrower)
            if limits.min <= low and high <= limits.max:
                return values.astype(narrower)
        if -_EXACT <= low and high <= _EXACT:
            return values.astype("f8")
    return None


def _write(stream: BinaryIO, elements: list[tuple[str, list[Column]]]) -> None:
    lines = ["ply", "format binary_little_endian 1.0"]
    for name, columns in elements:
        lines.append(f"element {name} {_count(columns)}")
        for label, column in columns:
            if isinstance(column, Ragged):
                lines.append(f"property list {_type(column.sizes)} {_type(column.values)} {label}")
            else:
                lines.append(f"property {_type(column)} {label}")
    stream.write("\n".join([*lines, "end_header", ""]).encode("latin1", "replace"))
    for _, columns in elements:
        if columns:
            stream.write(_rows(columns).tobytes())


def _count(columns: list[Column]) -> int:
    if not columns:
        return 0
    first = columns[0][1]
    return len(first.sizes) if isinstance(first, Ragged) else len(first)


def _kind(values: np.ndarray) -> str:
    kind = values.dtype.kind + str(values.dtype.itemsize)
    if kind in _NAMES:
        return kind
    return _WIDER.get(kind, "f8" if kind[0] == "f" else "i4")


def _type(values: np.ndarray) -> str:
    return _NAMES[_kind(values)]


def _rows(columns: list[Column]) -> UInt8[np.ndarray, " bytes"]:
    """The rows of an element; those with lists differ in size."""
    arrays = [column for _, column in columns if isinstance(column, np.ndarray)]
    if len(arrays) == len(columns):
        layout = [(f"{k}", "<" + _kind(array)) for k, array in enumerate(arrays)]
        rows = np.empty(len(arrays[0]), layout)
        for k, array in enumerate(arrays):
            rows[f"{k}"] = array
        return rows.view(np.uint8)
    count = _count(columns)
    widths = []  # bytes of each part in each row
    parts = []
    for _, column in columns:
        if isinstance(column, Ragged):
            counter = column.sizes.astype("<" + _kind(column.sizes))
            numbers = column.values.astype("<" + _kind(column.values)).ravel()
            parts += [counter.view(np.uint8), numbers.view(np.uint8)]
            sizes = column.sizes.astype(np.int64)
            widths += [np.full(count, counter.itemsize), sizes * numbers.itemsize]
        else:
            numbers = column.astype("<" + _kind(column))
            parts.append(numbers.view(np.uint8))
            widths.append(np.full(count, numbers.itemsize))
    ends = np.cumsum(np.stack(widths, axis=1).ravel()).reshape(count, len(widths))
    out = np.empty(int(ends[-1, -1]) if count else 0, np.uint8)
    for k, (part, width) in enumerate(zip(parts, widths, strict=True)):
        begins = ends[:, k] - width
        within = np.cumsum(width) - width
        out[np.arange(len(part)) + np.repeat(begins - within, width)] = part
    return out
