"""OFF and OBJ: meshes of vertices and faces, in text."""

from __future__ import annotations

import re

import numpy as np

from cfr_jax.io.cloud import CloudFileError, PointCloud
from cfr_jax.io.formats.text.lines import Lines, clean_text
from cfr_jax.io.mesh import Mesh, fan_triangles
from cfr_jax.io.table import cloud_of_filled

_COMMENT = re.compile(rb"#[^\n]*")
_OFF_MARK = re.compile(rb"\s*(?:ST)?(?:C)?(?:N)?OFF")

_NO_FACES = "has no faces: took its vertices for a cloud"
_INDENT = re.compile(rb"^[ \t]+", re.MULTILINE)
_TEXTURE_AND_NORMAL = re.compile(rb"/\S*")


def parse_off(data: bytes, name: str) -> Mesh:
    """OFF in text, also with colors (COFF) or normals (NOFF), which are left out."""
    text = _COMMENT.sub(b"", clean_text(data))
    mark = _OFF_MARK.match(text)
    if mark is None:
        raise CloudFileError(f"byte 0: starts with {text[:16]!r}, wanted 'OFF' and text")
    # ModelNet40 glues the counts to the mark ("OFF490 518 0").
    lines = Lines(text[mark.end() :], text.count(b"\n", 0, mark.end()) + 1)
    counts = lines.run(0, 1, "lines of counts").table()[0]
    if len(counts) < 2 or not np.all((counts >= 0) & (counts < 2**53) & (counts % 1 == 0)):
        raise CloudFileError(f"line {lines.first}: wanted counts of vertices and faces")
    vertices, faces = int(counts[0]), int(counts[1])
    if vertices == 0:
        raise CloudFileError("holds no vertices, wanted at least three")
    table = lines.run(1, vertices, "vertices").table()
    if table.shape[1] < 3:
        raise CloudFileError(f"the vertices have {table.shape[1]} coordinates, wanted three")

    rows = lines.run(1 + vertices, faces, "faces")
    values, starts = rows.rows()
    sizes = values[starts]
    room = np.diff(starts, append=len(values)) - 1
    good = (sizes >= 0) & (sizes <= room) & (sizes % 1 == 0)
    if not good.all():
        face = int(np.argmin(good))
        raise CloudFileError(
            f"face {face} of {faces} promises {sizes[face]:g} corners, its line holds {room[face]}"
        )
    triangles = fan_triangles(values, starts + 1, sizes.astype(np.int64))
    return Mesh(table[:, :3], triangles, name)


def parse_obj(data: bytes, name: str) -> Mesh | PointCloud:
    """The lines `v` and `f` of an OBJ; everything else (materials, groups, ...) is left out.

    A file without a line `f` is a cloud of its vertices, and a note says so.
    """
    text = _INDENT.sub(b"", clean_text(data).replace(b"\\\n", b"  "))
    vertices, faces = _tagged(text, b"v"), _tagged(text, b"f")
    if len(vertices) == 0:
        raise CloudFileError("holds no line 'v x y z', wanted three at least")
    # Fourth and later numbers, a weight or a color, may stand on some lines only.
    values, starts = vertices.rows()
    _check_lines(vertices, starts, values, at_least=3)
    points = values[starts[:, None] + np.arange(3)]
    if len(faces) == 0:
        return cloud_of_filled(points, None, name, (_NO_FACES,))

    corners, starts = Lines(_TEXTURE_AND_NORMAL.sub(b"", faces.data)).rows()
    _check_lines(faces, starts, corners, at_least=1)
    sizes = np.diff(starts, append=len(corners))
    # Indices count from one; negative ones count back from the vertex last seen.
    seen = np.repeat(np.searchsorted(vertices.starts, faces.starts), sizes)
    corners = np.where(corners < 0, corners + seen, corners - 1)
    return Mesh(points, fan_triangles(corners, starts, sizes), name)


def _tagged(text: bytes, tag: bytes) -> Lines:
    """The lines that open with the tag, without it; all else is blank, so that lines keep their
    numbers."""
    raw = np.frombuffer(text + b"\n", np.uint8)
    starts = np.concatenate([[0], np.flatnonzero(raw == 10) + 1])
    lengths = np.diff(starts)
    first, second = raw[starts[:-1]], raw[np.minimum(starts[:-1] + 1, len(raw) - 1)]
    chosen = (first == tag[0]) & ((second == 32) | (second == 9))
    tags = starts[:-1][chosen]
    kept = np.where(np.repeat(chosen, lengths) | (raw == 10), raw, 32).astype(np.uint8)
    kept[tags] = 32
    return Lines(kept.tobytes())


def _check_lines(lines: Lines, starts: np.ndarray, values: np.ndarray, at_least: int) -> None:
    if len(starts) != len(lines):
        raise CloudFileError(f"{len(lines) - len(starts)} faces have no corners")
    short = np.diff(starts, append=len(values)) < at_least
    if short.any():
        where = lines.data.count(b"\n", 0, int(lines.starts[int(np.argmax(short))])) + 1
        raise CloudFileError(f"line {where}: wanted {at_least} numbers at least")
