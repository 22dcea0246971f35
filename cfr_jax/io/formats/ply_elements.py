"""The body of a PLY file: rows of an element, whose list properties make them differ in size."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from cfr_jax.io.cloud import CloudFileError
from cfr_jax.io.formats.ascii import Lines, clean_text

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_STRUCT_CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I"}
_POLYGONS = ("vertex_indices", "vertex_index")


@dataclass(frozen=True)
class Element:
    """An element of the header: the number type of each property and, for the lists among them,
    of the count that precedes the list."""

    name: str
    count: int
    types: dict[str, str]
    counters: dict[str, str]

    @property
    def polygons(self) -> str | None:
        """The list property that names the corners of faces."""
        return next((label for label in _POLYGONS if label in self.counters), None)


# Of each element: its properties that are no lists, by name.
Columns = dict[str, dict[str, np.ndarray]]
# Of each element with polygons: all their corners, and where each polygon starts and its size.
Lists = dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]


def read_text(data: bytes, body: int, elements: list[Element]) -> tuple[Columns, Lists]:
    """All elements of a text file, which gives each row a line."""
    first = clean_text(data[:body]).count(b"\n") + 1
    lines = Lines(clean_text(data[body:]), first)
    columns: Columns = {}
    lists: Lists = {}
    taken = 0
    for element in elements:
        if not element.types:
            continue
        rows = lines.run(taken, element.count, f"rows of element {element.name!r}")
        taken += element.count
        if not element.counters:
            columns[element.name] = _text_columns(rows, element)
            continue
        values, position = rows.rows()
        ends = np.append(position[1:], len(values))
        found: dict[str, np.ndarray] = {}
        for label in element.types:  # one property of all rows at a time
            _check_rows(position < ends, rows, element)
            if label not in element.counters:
                found[label] = values[position]
                position = position + 1
                continue
            lengths = values[position]
            position = position + 1
            # Also false for NaN, which no count may be.
            fits = (lengths >= 0) & (lengths <= ends - position) & (lengths % 1 == 0)
            _check_rows(fits, rows, element)
            sizes = lengths.astype(np.int64)
            if label == element.polygons:
                lists[element.name] = (values, position, sizes)
            position = position + sizes
        _check_rows(position == ends, rows, element)
        columns[element.name] = found
    return columns, lists


def _text_columns(rows: Lines, element: Element) -> dict[str, np.ndarray]:
    """The properties of an element without lists."""
    table = rows.table()
    if len(table) and table.shape[1] != len(element.types):
        _check_rows(np.zeros(1, bool), rows, element)
    return {
        label: table[:, column] if len(table) else np.empty(0)
        for column, label in enumerate(element.types)
    }


def _check_rows(good: np.ndarray, rows: Lines, element: Element) -> None:
    if not good.all():
        row = int(np.argmin(good))
        line = rows.first + rows.data.count(b"\n", 0, int(rows.starts[row]))
        raise CloudFileError(
            f"line {line}: row {row} of element {element.name!r} has more or fewer numbers than "
            f"its properties ({', '.join(element.types)})"
        )


def read_binary(
    data: bytes, offset: int, order: str, elements: list[Element]
) -> tuple[Columns, Lists]:
    """All elements of a binary file; `order` is numpy's sign of the byte order."""
    columns: Columns = {}
    lists: Lists = {}
    for element in elements:
        if element.count == 0 or not element.types:
            columns[element.name] = {label: np.empty(0) for label in element.types}
            continue
        lengths = _first_lengths(data, offset, order, element)
        dtype = _row_type(order, element, lengths)
        rows = _equal_rows(data, offset, dtype, element, lengths)
        if rows is not None:
            offset += element.count * dtype.itemsize
            columns[element.name] = {key: rows[key] for key in element.types if key not in lengths}
            if element.polygons is not None:
                length = lengths[element.polygons]
                starts = np.arange(element.count) * length
                sizes = np.full(element.count, length)
                lists[element.name] = (rows[element.polygons].ravel(), starts, sizes)
        else:
            offset = _walk_rows(data, offset, order, element, lists)
            columns[element.name] = {}
    return columns, lists


def _first_lengths(data: bytes, offset: int, order: str, element: Element) -> dict[str, int]:
    """The length of each list in the element's first row."""
    lengths = {}
    for label, kind in element.types.items():
        if label in element.counters:
            lengths[label], offset = _list_length(data, offset, order, element, label, row=0)
        offset += lengths.get(label, 1) * int(kind[1])
    return lengths


def _row_type(order: str, element: Element, lengths: dict[str, int]) -> np.dtype:
    fields: list[tuple] = []
    for label, kind in element.types.items():
        if label in lengths:
            fields.append((f"count of {label}", order + element.counters[label]))
            fields.append((label, order + kind, (lengths[label],)))
        else:
            fields.append((label, order + kind))
    return np.dtype(fields)


def _equal_rows(
    data: bytes, offset: int, dtype: np.dtype, element: Element, lengths: dict[str, int]
) -> np.ndarray | None:
    """The rows as one array; None if lists of different lengths make them differ in size."""
    size = element.count * dtype.itemsize
    if offset + size <= len(data):
        rows = np.frombuffer(data, dtype, element.count, offset)
        same = ((rows[f"count of {label}"] == length).all() for label, length in lengths.items())
        return rows if all(same) else None
    if not lengths:
        raise CloudFileError(
            f"byte {offset}: {element.count} rows of element {element.name!r} are {size} bytes, "
            f"the file holds {max(len(data) - offset, 0)}"
        )
    return None


def _walk_rows(data: bytes, offset: int, order: str, element: Element, lists: Lists) -> int:
    """Goes through rows of different sizes one by one; returns the offset behind them.

    A row with a list takes a byte at least, so no count in a header can make this run away.
    """
    corners = bytearray()
    sizes = []
    for row in range(element.count):
        for label, kind in element.types.items():
            if label not in element.counters:
                offset += int(kind[1])
                continue
            length, offset = _list_length(data, offset, order, element, label, row)
            end = offset + length * int(kind[1])
            if label == element.polygons:
                corners += data[offset:end]
                sizes.append(length)
            offset = end
    if element.polygons is not None:
        values = np.frombuffer(corners, order + element.types[element.polygons])
        lengths = np.array(sizes, np.int64)
        lists[element.name] = (values, np.cumsum(lengths) - lengths, lengths)
    return offset


def _list_length(
    data: bytes, offset: int, order: str, element: Element, label: str, row: int
) -> tuple[int, int]:
    """The count before a list, and the offset of the list, which the file is known to hold."""
    counter = element.counters[label]
    start = offset + int(counter[1])
    length = -1
    if start <= len(data):
        (length,) = struct.unpack_from(order + _STRUCT_CODES[counter], data, offset)
    if length < 0 or start + length * int(element.types[label][1]) > len(data):
        raise CloudFileError(
            f"byte {offset}: row {row} of {element.count} of element {element.name!r} wants a "
            f"list {label!r} of 0 or more that the file ({len(data)} bytes) holds"
        )
    return length, start
