"""Meshes in the formats of games, written byte by byte."""

from __future__ import annotations

import struct

import numpy as np


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
