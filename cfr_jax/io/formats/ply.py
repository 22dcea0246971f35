"""PLY: text or binary of either byte order, clouds and meshes.

Parsed here since the readers at hand believe the header: a flipped digit in an element's count
makes them allocate it, and damaged lists raise whatever comes.
"""

from __future__ import annotations

import re
from typing import BinaryIO

import numpy as np

from cfr_jax.io.cloud import CloudFileError, PointCloud, as_float64, usable_normals
from cfr_jax.io.formats.ascii import clean_text
from cfr_jax.io.formats.ply_elements import TYPES, Element, read_binary, read_text
from cfr_jax.io.mesh import Mesh, fan_triangles

_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 1 << 16
_FACES = re.compile(rb"element\s+(?:face|tristrips)\s+(\d+)")


def parse(data: bytes, name: str) -> PointCloud | Mesh:
    """A mesh if the file has faces, else a cloud; normals are the properties nx, ny, nz."""
    order, elements, body = _parse_header(data)
    if not any(element.name == "vertex" for element in elements):
        raise CloudFileError("wanted an element 'vertex', the header has none")
    columns, lists = read_binary(data, body, order, elements) if order else read_text(
        data, body, elements
    )  # fmt: skip
    vertex = columns["vertex"]
    missing = [axis for axis in "xyz" if axis not in vertex]
    if missing:
        raise CloudFileError(f"element 'vertex' has no property {missing[0]!r}")
    points = np.column_stack([as_float64(vertex[axis]) for axis in "xyz"])
    normals = None
    if len(points) and all(axis in vertex for axis in ("nx", "ny", "nz")):
        normals = usable_normals(
            np.column_stack([as_float64(vertex[axis]) for axis in ("nx", "ny", "nz")])
        )
    if "face" in lists:
        return Mesh(points, fan_triangles(*lists["face"]), name, normals)
    return PointCloud(points, normals, name)


def has_faces(start: bytes) -> bool:
    """Whether the header, or as much of it as is in the first bytes, counts any face."""
    match = _FACES.search(start.partition(b"end_header")[0])
    return match is not None and int(match[1]) > 0


def _parse_header(data: bytes) -> tuple[str, list[Element], int]:
    """Byte order ('' for text), elements, and the offset of the body."""
    if not data.startswith((b"ply\n", b"ply\r")):
        raise CloudFileError(f"byte 0: starts with {data[:8]!r}, wanted a line 'ply'")
    mark = data.find(b"end_header", 0, _LONGEST_HEADER)
    if mark < 0:
        raise CloudFileError("wanted a line 'end_header', found none")
    body = mark + len(b"end_header")
    ending = data[body : body + 2]
    if ending[:1] not in (b"\n", b"\r"):
        raise CloudFileError(f"byte {body}: wanted the end of the line after 'end_header'")
    body += 2 if ending == b"\r\n" else 1

    order: str | None = None
    elements: list[Element] = []
    for number, line in enumerate(clean_text(data[:mark]).decode("latin1").split("\n"), 1):
        match line.split():
            case ["format", kind, "1.0"] if kind in _ORDERS and order is None:
                order = _ORDERS[kind]
            case ["element", kind, count] if count.isdecimal() and len(count) < 16:
                if any(element.name == kind for element in elements):
                    raise CloudFileError(f"line {number}: a second element {kind!r}")
                elements.append(Element(kind, int(count), {}, {}))
            case ["property", *kinds, label] if elements and label not in elements[-1].types:
                match kinds:
                    case [kind] if kind in TYPES:
                        elements[-1].types[label] = TYPES[kind]
                    case ["list", counter, kind] if (
                        kind in TYPES and TYPES.get(counter, "f")[0] != "f"
                    ):
                        elements[-1].types[label] = TYPES[kind]
                        elements[-1].counters[label] = TYPES[counter]
                    case _:
                        raise CloudFileError(f"line {number}: unknown type in {line[:80]!r}")
            case [] | ["ply"] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise CloudFileError(f"line {number}: cannot make sense of {line[:80]!r}")
    if order is None:
        raise CloudFileError("wanted a line 'format' with ascii or binary and 1.0, found none")
    return order, elements, body


def save(stream: BinaryIO, cloud: PointCloud) -> None:
    """Little-endian doubles, which every reader of PLY takes; nothing is rounded."""
    labels, table = ["x", "y", "z"], cloud.points
    if cloud.normals is not None:
        labels += ["nx", "ny", "nz"]
        table = np.hstack([cloud.points, cloud.normals])
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    lines += [f"property double {label}" for label in labels] + ["end_header", ""]
    stream.write("\n".join(lines).encode())
    stream.write(table.astype("<f8").tobytes())
