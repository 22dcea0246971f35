"""STL: triangles that share no vertices, in rows of fixed size or in text."""

from __future__ import annotations

import re

import numpy as np

from cfr_jax.io.cloud import CloudFileError
from cfr_jax.io.formats.text.lines import Lines, clean_text
from cfr_jax.io.mesh import Mesh

_ROW = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_FACET = re.compile(
    rb"\s*facet\s+normal\s+\S+\s+\S+\s+\S+\s+outer\s+loop"
    + rb"\s+vertex\s+(\S+\s+\S+\s+\S+)" * 3
    + rb"\s+endloop\s+endfacet(?=\s)",
    re.IGNORECASE,
)
_SOLID = re.compile(rb"\s*solid(?![^\s])[^\n]*\n", re.IGNORECASE)
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
    if text[:5].lower() != b"solid":
        raise CloudFileError(f"byte 0: starts with {text[:8]!r}, wanted 'solid' or a binary STL")
    position = 0
    corners: list[bytes] = []
    while solid := _SOLID.match(text, position):
        position = solid.end()
        while facet := _FACET.match(text, position):
            corners += facet.groups()
            position = facet.end()
        end = _END.match(text, position)
        if end is None:
            line = text.count(b"\n", 0, position) + 1
            raise CloudFileError(f"behind line {line}: wanted a whole facet, or 'endsolid'")
        position = end.end()
    if text[position:].strip():
        line = text.count(b"\n", 0, position) + 1
        raise CloudFileError(f"behind line {line}: wanted 'solid' or the end of the file")
    joined = b"\n".join(corner.replace(b"\n", b" ") for corner in corners)
    return _soup(Lines(joined).table().reshape(-1, 3), name)


def _soup(corners: np.ndarray, name: str) -> Mesh:
    """Triangles that share no vertices."""
    return Mesh(corners, np.arange(len(corners)).reshape(-1, 3), name)
