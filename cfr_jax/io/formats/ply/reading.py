"""PLY: text or binary of either byte order, clouds and meshes.

Read here because the libraries at hand believe the header: a flipped digit in the count of an
element makes them allocate it, and damaged lists raise whatever comes.
"""

from __future__ import annotations

import re

from cfr_jax.io.budget import check_room, check_surface
from cfr_jax.io.cloud import CloudFileError, PointCloud
from cfr_jax.io.formats.ply.binary import read_binary
from cfr_jax.io.formats.ply.elements import (
    TYPES,
    Element,
    Held,
    Property,
    Ragged,
    read_text,
)
from cfr_jax.io.formats.text.lines import clean_text
from cfr_jax.io.mesh import Mesh, Polygons, triangles_within
from cfr_jax.io.table import table_of

FORMAT = "PLY"
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 1 << 16
_FACES = re.compile(rb"element\s+(?:face|tristrips)\s+(\d+)", re.IGNORECASE)
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_END = re.compile(rb"end_header[ \t]*(\r\n|\n|\r)", re.IGNORECASE)


def parse(
    data: bytes, name: str, *, columns: tuple[str, ...] | None = None, whole: bool = False
) -> PointCloud | Mesh:
    """A mesh if the file has faces, else a cloud. The names of the properties say what they are."""
    order, elements, body = _parse_header(data)
    vertex = next((k for k, element in enumerate(elements) if element.name == "vertex"), None)
    if vertex is None:
        raise CloudFileError("wanted an element 'vertex', the header has none")
    notes: list[str] = []
    if order:
        held = read_binary(data, body, order, elements, whole)
    else:
        held, notes = read_text(clean_text(data), body, elements, whole)
    names, values = [], []
    for prop, column in zip(elements[vertex].properties, held[vertex], strict=True):
        if column is not None and not isinstance(column, Ragged):
            names.append(prop.name)
            values.append(column)
    each = 48 if whole and elements[vertex].has_lists else 24
    check_room(elements[vertex].count, each, len(data), "vertices")
    polygons = _polygons(elements, held)
    if polygons is not None:
        # Unless they are views of the file, the polygons are held beside the triangles.
        taken = sum(part.nbytes for part in polygons if part.base is None)
        count = triangles_within(polygons[1])
        check_surface(elements[vertex].count, count, len(data), taken)
    try:
        table = table_of(
            names,
            values,
            columns,
            polygons=polygons,
            rest=(elements, held, vertex) if whole else None,
            format=FORMAT,
        )
    except ValueError as error:
        raise CloudFileError(f"element 'vertex' {error}") from None
    return table.shape(name, tuple(notes), whole)


def has_faces(start: bytes) -> bool:
    """Whether the header, or as much of it as is in the first bytes, counts any face."""
    match = _FACES.search(start.partition(b"end_header")[0])
    return match is not None and int(match[1]) > 0


def _polygons(elements: list[Element], held: list[Held]) -> Polygons | None:
    """The faces; None for a file without any, also if it has an empty element for them."""
    for element, columns in zip(elements, held, strict=True):
        position = element.polygons
        if element.name == "face" and element.count and position is not None:
            lists = columns[position]
            if isinstance(lists, Ragged):
                return lists.values, lists.sizes
    return None


def _parse_header(data: bytes) -> tuple[str, list[Element], int]:
    """Byte order ('' for text), elements, and the offset of the body."""
    begin = len(_BYTE_ORDER_MARK) if data.startswith(_BYTE_ORDER_MARK) else 0
    if not re.match(rb"ply[ \t]*[\r\n]", data[begin : begin + 64], re.IGNORECASE):
        raise CloudFileError(f"byte 0: starts with {data[:8]!r}, wanted a line 'ply'")
    end = _END.search(data, begin, _LONGEST_HEADER)
    if end is None:
        mark = data.lower().find(b"end_header", 0, _LONGEST_HEADER)
        if mark >= 0:
            raise CloudFileError(f"byte {mark}: wanted the end of the line after 'end_header'")
        raise CloudFileError("wanted a line 'end_header', found none")

    order: str | None = None
    elements: list[Element] = []
    text = clean_text(data[begin : end.start()]).decode("latin1")
    for number, line in enumerate(text.split("\n"), 1):
        words = line.split()
        match [word.lower() for word in words[:1]] + words[1:]:
            case ["format", kind, "1.0", *_] if kind in _ORDERS and order is None:
                order = _ORDERS[kind]
            case ["element", kind, count] if count.isdecimal() and len(count) < 16:
                if any(element.name == kind.lower() for element in elements):
                    raise CloudFileError(f"line {number}: a second element {kind!r:.40}")
                elements.append(Element(kind.lower(), int(count), []))
            case ["property", *kinds, label] if elements:
                elements[-1].properties.append(_property(kinds, label, number, line))
            case [] | ["ply"] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise CloudFileError(f"line {number}: cannot make sense of {line[:80]!r}")
    if order is None:
        raise CloudFileError("wanted a line 'format' with ascii or binary and 1.0, found none")
    return order, elements, end.end()


def _property(kinds: list[str], label: str, number: int, line: str) -> Property:
    match [kind.lower() for kind in kinds]:
        case [kind] if kind in TYPES:
            return Property(label, TYPES[kind])
        case ["list", counter, kind] if kind in TYPES and TYPES.get(counter, "f")[0] in "iu":
            return Property(label, TYPES[kind], TYPES[counter])
    raise CloudFileError(f"line {number}: unknown type in {line[:80]!r}")
