"""PIE, versions 2 to 4, the models of the game Warzone 2100: points and polygons in text."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import islice, zip_longest

import numpy as np

from cfr_jax.io.budget import POINT, check_surface
from cfr_jax.io.cloud import CloudFileError
from cfr_jax.io.formats.meshes.surfaces import append_polygons, polygons_of
from cfr_jax.io.formats.text.lines import (
    Lines,
    Ragged,
    Text,
    behind_mark,
    blocks,
    clean_text,
    filled_starts,
    ragged,
)
from cfr_jax.io.growing import Growing
from cfr_jax.io.mesh import Mesh

_MARK = re.compile(rb"\s*PIE[ \t]+([234])(?=\s)")
_SECTION = re.compile(rb"^[ \t]*(POINTS|POLYGONS)[ \t]+(\d{1,9})[ \t\r]*$", re.MULTILINE)
_LEVELS = re.compile(rb"^[ \t]*LEVELS[ \t]+(\d{1,9})\b", re.MULTILINE)
_FLAGS = re.compile(rb"^[ \t]*[0-9a-fA-F]+(?=[ \t])", re.MULTILINE)
_MOST_SECTIONS = 10_000  # each takes time, however little it holds


def parse(data: bytes, name: str) -> Mesh:
    """The polygons of all levels as one mesh; y up.

    Polygons have flags, which are hexadecimal, before their corners, and places in a texture behind
    them. Both are left out, and so are connectors and animations.
    """
    data = clean_text(data)
    begin = behind_mark(data)
    if _MARK.match(data, begin) is None:
        raise CloudFileError(
            f"byte 0: starts with {data[:8]!r}, wanted 'PIE 2', 'PIE 3' or 'PIE 4'"
        )
    points, triangles = Growing("f8", 3), Growing("i8", 3)
    levels, first = 0, 0  # read so far, and the vertex with which the present one begins
    for kind, text, count in _sections(data, begin):
        if kind == b"POINTS":
            levels, first = levels + 1, len(points)
            check_surface(first + count, len(triangles), len(data), taken=POINT * count)
            table = text.take(count, "points").table() if count else np.empty((0, 3))
            if table.shape[1] < 3:
                raise CloudFileError(f"points have {table.shape[1]} coordinates, wanted three")
            points.append(table[:, :3])
            continue
        rows, here = text.take(count, "polygons"), len(points) - first
        for corners, sizes in polygons_of(_without_flags(rows), count):
            if not ((corners >= 0) & (corners < here)).all():
                raise CloudFileError(
                    f"behind line {rows.first - 1}: a polygon names vertex {corners.max():g} or "
                    f"{corners.min():g}, wanted 0 to {here - 1}"
                )
            append_polygons(triangles, corners + first, sizes, len(points), len(data))
    promised = _LEVELS.search(data, begin)
    if promised and levels < int(promised[1]):
        raise CloudFileError(f"ends after {levels} of {int(promised[1])} levels")
    if not len(points):
        raise CloudFileError("holds no line 'POINTS n' with points behind it")
    return Mesh(points.joined(), triangles.joined(), name)


def _sections(data: bytes, begin: int) -> Iterator[tuple[bytes, Text, int]]:
    """What each section holds, its lines, and how many of them count."""
    found = list(islice(_SECTION.finditer(data, begin), _MOST_SECTIONS + 1))
    if len(found) > _MOST_SECTIONS:
        raise CloudFileError(f"has more than {_MOST_SECTIONS} lists of points and polygons")
    line = 1
    for match, behind in zip_longest(found, found[1:]):
        line += data.count(b"\n", begin, match.end())
        begin = match.end()
        end = len(data) if behind is None else behind.start()
        yield match[1], Text(data, begin, line, end=end), int(match[2])


def _without_flags(rows: Lines) -> Iterator[Ragged]:
    """Of each polygon how many corners it has, the corners, and what else there is."""
    for line, block in blocks(rows.data, rows.begin, rows.end, rows.first):
        text, found = _FLAGS.subn(b"", block)
        if found != len(filled_starts(block)):
            raise CloudFileError(f"behind line {line - 1}: a polygon does not begin with its flags")
        yield ragged(text, line)
