"""Meshes in the formats of games, written byte by byte, and some that grow when they are read."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable

import numpy as np

_HEAD = b"AC3Db\nOBJECT world\nkids 1\nOBJECT poly\n"
_VERTICES = b"numvert 3\n0 0 0\n1 0 0\n0 1 0\n"
_FACE = b"refs 3\n0 0 0\n1 0 0\n2 0 0\n"


def g3d(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """A surface as two meshes, one with textures, that move away after their first frame."""
    positions = vertices.astype("<f4")
    count = len(positions)
    whole = b"G3D" + struct.pack("<BHB", 4, 2, 0)
    for name, part, textures in ((b"bottom", faces[:5], 0b101), (b"top", faces[5:], 0)):
        whole += struct.pack("<64s3I8f2I", name, 2, count, part.size, *[0.5] * 8, 3, textures)
        whole += b"texture.png".ljust(64, b"\0") * textures.bit_count()
        whole += positions.tobytes() + (positions + 100).tobytes()
        whole += np.full((2, count, 3), 7, "<f4").tobytes()  # normals
        whole += bytes(8 * count) if textures else b""
        whole += part.astype("<u4").tobytes()
    return whole


def pie(corners: np.ndarray, sides: list[list[int]]) -> bytes:
    """Polygons as two levels, with hexadecimal flags, places in a texture, and a connector."""
    text = "PIE 3\nTYPE 200\nTEXTURE 0 page.png 256 256\nLEVELS 2\n"
    for level, flags, chosen in ((1, "200", sides[:3]), (2, "aE0", sides[3:])):
        rows = "".join(f"\t{' '.join(map(str, row))} \n" for row in corners)
        text += f"LEVEL {level}\nPOINTS {len(corners)}\n{rows}POLYGONS {len(chosen)}\n"
        for side in chosen:
            places = " 0.5 1" * len(side)
            text += f"\t{flags} {len(side)} {' '.join(map(str, side))}{places}\n"
        text += "CONNECTORS 1\n\t1 2 3\n"
    return text.encode()


def game_makers() -> dict[str, Callable[[int, random.Random], bytes]]:
    """PMD and AC3D that grow when they are read, as in `amplifiers`."""
    return {
        "vertices.pmd": lambda size, rng: pmd(size // 44, 1),
        "faces.pmd": lambda size, rng: pmd(3, size // 6),
        "sets.pmd": lambda size, rng: pmd(3, 1, sets=rng.choice((size // 24, 2**32 - 1))),
        "vertices.ac": lambda size, rng: ac3d_vertices(size // 6),
        "objects.ac": ac3d_objects,
        "levels.ac": lambda size, rng: b"AC3Db\n" + b"OBJECT a\nkids 1\n" * (size // 16),
        "children.ac": lambda size, rng: _HEAD + b"kids 999999999\n" + b"\n" * size,
        "surfaces.ac": ac3d_surfaces,
        "polygon.ac": lambda size, rng: ac3d_polygons(
            size, rng.choice((5_000, 100_000, size // 6))
        ),
        "keys.ac": lambda size, rng: _HEAD + rng.choice((b"loc 0 0 0\n", b"kids\n")) * (size // 9),
        "newlines.ac": lambda size, rng: _HEAD + rng.choice((b"\n", b" \n", b"a\n")) * (size // 2),
        "blanks.ac": lambda size, rng: _HEAD + _VERTICES + b"numsurf 9\n" + b" " * size + _FACE,
        "text.ac": lambda size, rng: (
            _HEAD + b"data %d\n" % (size // 2) + b"\r\n" * (size // 2) + ac3d_vertices(3)
        ),
        "materials.ac": lambda size, rng: b"AC3Db\n" + b"MATERIAL\n" * (size // 9) + _HEAD[6:],
        "words.ac": lambda size, rng: _HEAD + b"loc" + b" 0" * (size // 2) + b"\n",
    }


def pmd(vertices: int, faces: int, sets: int = 0) -> bytes:
    room = (44 + 8 * sets) * vertices if sets < 2**31 else 0
    body = struct.pack("<II", vertices, sets) + bytes(room) + struct.pack("<I", faces)
    return b"PSMD" + struct.pack("<II", 4, len(body)) + body + struct.pack("<3H", 0, 1, 2) * faces


def ac3d_vertices(count: int) -> bytes:
    return _HEAD + b"numvert %d\n" % count + b"0 0 0\n" * count + b"numsurf 0\nkids 0\n"


def ac3d_objects(size: int, rng: random.Random) -> bytes:
    """Objects that hold nothing, or a triangle."""
    whole = b"OBJECT a\n" + _VERTICES + b"numsurf 1\n" + _FACE + b"kids 0\n"
    each = rng.choice((b"OBJECT a\nkids 0\n", whole))
    count = size // len(each)
    return b"AC3Db\nOBJECT world\nkids %d\n" % (count + 1) + whole + each * count


def ac3d_surfaces(size: int, rng: random.Random) -> bytes:
    each = rng.choice((b"refs 0\n", _FACE, b"SURF 1\n" + _FACE, b"SURF 0x20\nmat 0\n" + _FACE))
    count = size // len(each)
    surfaces = b"numsurf %d\n" % (count + 1) + _FACE + each * count
    return _HEAD + _VERTICES + surfaces + b"kids 0\n"


def ac3d_polygons(size: int, corners: int) -> bytes:
    face = b"refs %d\n" % corners + b"0 0 0\n1 0 0\n2 0 0\n" * (corners // 3)
    face += b"0 0 0\n" * (corners % 3)
    count = max(size // len(face), 1)
    return _HEAD + _VERTICES + b"numsurf %d\n" % count + face * count + b"kids 0\n"
