"""STL: triangles that share no vertices, in rows of fixed size or in text."""

from __future__ import annotations

import re

import numpy as np

from cfr_jax.io.budget import check_surface
from cfr_jax.io.cloud import CloudFileError
from cfr_jax.io.formats.text.lines import behind_mark, clean_text
from cfr_jax.io.growing import Growing
from cfr_jax.io.mesh import Mesh

_ROW = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_FACET = re.compile(
    rb"\s*facet\s+normal\s+\S+\s+\S+\s+\S+\s+outer\s+loop"
    + rb"\s+vertex\s+(\S+\s+\S+\s+\S+)" * 3
    + rb"\s+endloop\s+endfacet(?=\s)",
    re.IGNORECASE,
)
_SOLID = re.compile(rb"\s*solid(?![^\s])[^\n]*\n", re.IGNORECASE)
_BLANK = re.compile(rb"\s*")
_AT_ONCE = 30_000  # corners
_END = re.compile(rb"\s*endsolid[^\n]*(?:\n|$)", re.IGNORECASE)


def parse(data: bytes, name: str) -> Mesh:
    """Binary STL, recognized by its size, or the text form; corners are not merged."""
    if len(data) >= 84:
        count = int.from_bytes(data[80:84], "little")
        if 84 + count * _ROW.itemsize == len(data):
            rows = np.frombuffer(data, _ROW, count, 84)
            return _soup(rows["corners"].reshape(-1, 3), name)
        if data[:5].lower() != b"solid":
            raise CloudFileError(
                f"byte 80: {count} triangles are {84 + count * _ROW.itemsize} bytes, "
                f"the file has {len(data)}"
            )
    return _parse_stl_text(clean_text(data), name)


def _parse_stl_text(text: bytes, name: str) -> Mesh:
    """The facets of all solids in the file."""
    position = behind_mark(text)
    if text[position : position + 5].lower() != b"solid":
        raise CloudFileError(f"byte 0: starts with {text[:8]!r}, wanted 'solid' or a binary STL")
    corners = Growing("f8", 3)
    found: list[bytes] = []
    while solid := _SOLID.match(text, position):
        position = solid.end()
        while facet := _FACET.match(text, position):
            found += facet.groups()
            position = facet.end()
            if len(found) >= _AT_ONCE:
                corners.append(_numbers(found, text))
                found.clear()
                check_surface(len(corners), len(corners) // 3, len(text))
        end = _END.match(text, position)
        if end is None:
            line = text.count(b"\n", 0, position) + 1
            raise CloudFileError(f"behind line {line}: wanted a whole facet, or 'endsolid'")
        position = end.end()
    if not _BLANK.fullmatch(text, position):
        line = text.count(b"\n", 0, position) + 1
        raise CloudFileError(f"behind line {line}: wanted 'solid' or the end of the file")
    corners.append(_numbers(found, text))
    return _soup(corners.joined(), name)


def _numbers(found: list[bytes], text: bytes) -> np.ndarray:
    """Corners (n, 3) of three words each."""
    words = b" ".join(found).split()
    try:
        return np.array(words).astype(np.float64).reshape(-1, 3)
    except ValueError as error:
        raise CloudFileError(f"a corner is no number: {error}") from None


def _soup(corners: np.ndarray, name: str) -> Mesh:
    """Triangles that share no vertices."""
    return Mesh(corners, np.arange(len(corners), dtype=np.int64).reshape(-1, 3), name)
