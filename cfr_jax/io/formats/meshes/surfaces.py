"""OFF and OBJ: meshes of vertices and faces, in text."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

import numpy as np
from jaxtyping import Float64, Int64

from cfr_jax.io.budget import POINT, check_surface
from cfr_jax.io.cloud import CloudFileError, PointCloud
from cfr_jax.io.formats.text.lines import (
    Lines,
    Ragged,
    Text,
    behind_mark,
    block_end,
    clean_text,
    filled_starts,
    ragged,
)
from cfr_jax.io.growing import Growing
from cfr_jax.io.mesh import Mesh, fan_triangles, triangles_within
from cfr_jax.io.table import cloud_of_filled

_OFF_MARK = re.compile(rb"(?:[^\S\n]*(?:#[^\n]*)?\n)*\s*(?:ST)?(?:C)?(?:N)?OFF")

_LONGEST = 1 << 20  # bytes of a line that goes on behind backslashes
_NO_FACES = "has no faces: took its vertices for a cloud"
_INDENT = re.compile(rb"^[ \t]+", re.MULTILINE)
_TEXTURE_AND_NORMAL = re.compile(rb"/\S*")


def parse_off(data: bytes, name: str) -> Mesh:
    """OFF in text, also with colors (COFF) or normals (NOFF), which are left out."""
    data = clean_text(data)
    mark = _OFF_MARK.match(data, behind_mark(data))
    if mark is None:
        raise CloudFileError(f"byte 0: starts with {data[:16]!r}, wanted 'OFF' and text")
    # ModelNet40 glues the counts to the mark ("OFF490 518 0").
    text = Text(data, mark.end(), data.count(b"\n", 0, mark.end()) + 1, comments=True)
    said = text.take(1, "lines of counts")
    counts = said.table()[0]
    if len(counts) < 2 or not np.all((counts >= 0) & (counts < 2**53) & (counts % 1 == 0)):
        raise CloudFileError(f"line {said.first}: wanted counts of vertices and faces")
    vertices, faces = int(counts[0]), int(counts[1])
    if vertices == 0:
        raise CloudFileError("holds no vertices, wanted at least three")
    table = text.take(vertices, "vertices").table(each=POINT)
    if table.shape[1] < 3:
        raise CloudFileError(f"the vertices have {table.shape[1]} coordinates, wanted three")
    triangles = _off_triangles(text.take(faces, "faces"), table)
    return Mesh(table[:, :3], triangles, name)


def _off_triangles(rows: Lines, table: np.ndarray) -> Int64[np.ndarray, "t 3"]:
    triangles = Growing("i8", 3)
    for corners, sizes in polygons_of(rows.ragged(), rows.count):
        append_polygons(triangles, corners, sizes, table.nbytes // POINT, len(rows.data))
    return triangles.joined()


def polygons_of(
    rows: Iterable[Ragged], count: int
) -> Iterator[tuple[Float64[np.ndarray, " k"], Int64[np.ndarray, " r"]]]:
    """The corners of all polygons of a block, and how many each polygon has.

    Each of the `count` rows is a number of corners, the corners, and perhaps colors or the like,
    which are left out.
    """
    face = 0
    for block in rows:
        values, counts = block.values, block.counts
        starts = np.cumsum(counts) - counts
        sizes, room = values[starts], counts - 1
        good = (sizes >= 0) & (sizes <= room) & (sizes % 1 == 0)
        if not good.all():
            bad = int(np.argmin(good))
            raise CloudFileError(
                f"face {face + bad} of {count} promises {sizes[bad]:g} corners, its line "
                f"holds {room[bad]}"
            )
        place = np.arange(len(values)) - np.repeat(starts, counts)
        corners = values[(place > 0) & (place <= np.repeat(sizes, counts))]
        yield corners, sizes.astype(np.int64)
        face += len(counts)
    if face < count:
        raise CloudFileError(f"{count - face} of {count} faces have no corners")


def append_polygons(
    triangles: Growing, corners: np.ndarray, sizes: np.ndarray, vertices: int, size: int
) -> None:
    """Adds the triangles of a block of polygons, if a file of `size` bytes has room for them."""
    check_surface(vertices, len(triangles) + triangles_within(sizes), size)
    triangles.append(fan_triangles(corners, sizes, len(triangles)))


def parse_obj(data: bytes, name: str) -> Mesh | PointCloud:
    """The lines `v` and `f` of an OBJ; everything else (materials, groups, ...) is left out.

    A file without a line `f` is a cloud of its vertices, and a note says so.
    """
    data = clean_text(data)
    points, triangles = Growing("f8", 3), Growing("i8", 3)
    faces = 0
    for line, block in _obj_blocks(data):
        starts = filled_starts(block)
        raw = np.frombuffer(block + b" ", np.uint8)
        first, second = raw[starts], raw[starts + 1]
        tagged = (second == 32) | (second == 9)
        vertex, face = tagged & (first == ord("v")), tagged & (first == ord("f"))
        before = len(points)
        if vertex.any():
            values, counts = _numbers_of(block, starts, vertex, line, at_least=3)
            # Fourth and later numbers, a weight or a color, may stand on some lines only.
            points.append(values[(np.cumsum(counts) - counts)[:, None] + np.arange(3)])
            check_surface(len(points), len(triangles), len(data))
        if face.any():
            corners, sizes = _numbers_of(block, starts, face, line, at_least=1)
            # Indices count from one; negative ones count back from the vertex last seen.
            seen = np.repeat(before + np.cumsum(vertex)[face], sizes)
            corners = np.where(corners < 0, corners + seen, corners - 1)
            faces += len(sizes)
            append_polygons(triangles, corners, sizes, len(points), len(data))
    if len(points) == 0:
        raise CloudFileError("holds no line 'v x y z', wanted three at least")
    if faces == 0:
        return cloud_of_filled(points.joined(), None, name, (_NO_FACES,))
    return Mesh(points.joined(), triangles.joined(), name)


def _obj_blocks(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Whole lines, with the number of the first one; lines that go on behind a backslash are
    joined, and filled up by blank lines, so that lines keep their numbers."""
    begin, line = behind_mark(data), 1
    while begin < len(data):
        end = block_end(data, begin, len(data), line)
        while end < len(data) and data[end - 3 : end].endswith((b"\\\n", b"\\\r\n")):
            end = block_end(data, end, len(data), line)
            if end - begin > _LONGEST:
                raise CloudFileError(f"behind line {line}: one line goes on for too long")
        block = data[begin:end]
        newlines = block.count(b"\n")
        if b"\\" in block:
            block = block.replace(b"\\\r\n", b"  ").replace(b"\\\n", b"  ")
        if b"\n " in block or b"\n\t" in block or block[:1] in b" \t":
            block = _INDENT.sub(b"", block)
        if block.strip():
            yield line, block
        begin, line = end, line + newlines


def _numbers_of(
    block: bytes,
    starts: Int64[np.ndarray, " k"],
    chosen: np.ndarray,
    line: int,
    at_least: int,
) -> tuple[Float64[np.ndarray, " n"], Int64[np.ndarray, " r"]]:
    """The numbers behind the first letter of the chosen lines, and how many each line has."""
    raw = np.frombuffer(block, np.uint8)
    lengths = np.diff(starts, append=len(raw))
    kept = np.where(np.repeat(chosen, lengths) | (raw[starts[0] :] == 10), raw[starts[0] :], 32)
    kept[starts[chosen] - starts[0]] = 32
    text = kept.astype(np.uint8).tobytes()
    if b"/" in text:
        text = _TEXTURE_AND_NORMAL.sub(b"", text)
    found = ragged(text, line + block.count(b"\n", 0, int(starts[0])))
    missing = int(np.count_nonzero(chosen)) - len(found.counts)
    if missing:
        what = "faces have no corners" if at_least == 1 else "vertices have no coordinates"
        raise CloudFileError(f"behind line {line}: {missing} {what}")
    if found.counts.min() < at_least:
        where = found.line(int(np.argmin(found.counts)))
        raise CloudFileError(f"line {where}: wanted {at_least} numbers at least")
    return found.values, found.counts
