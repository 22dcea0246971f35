"""Meshes that grow when they are read, as in `amplifiers`: in text, STL and glTF."""

from __future__ import annotations

import json
import random
import struct
from collections.abc import Callable

import numpy as np

_TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()


def mesh_makers() -> dict[str, Callable[[int, random.Random], bytes]]:
    return {
        "polygon.off": lambda size, rng: off(1, size // 2),
        "short faces.off": lambda size, rng: off(size // 8, 3),
        "newlines.off": lambda size, rng: off(1, 3) + b"\n" * size,
        "newlines.obj": lambda size, rng: obj(1, 3) + rng.choice((b"\n", b"\\\n", b" ")) * size,
        "polygon.obj": lambda size, rng: obj(1, size // 2),
        "short lines.obj": lambda size, rng: obj(size // 8, 3),
        "vertices.obj": lambda size, rng: b"v 1 2 3\nv 1 2 4\n" * (size // 16),
        "others.obj": lambda size, rng: obj(1, 3) + rng.choice((b"g\n", b"#\n")) * (size // 2),
        "solids.stl": stl_text,
        "one solid.stl": lambda size, rng: stl_text(size, rng, solids=False),
        "soup.stl": stl_binary,
        "arrays.gltf": lambda size, rng: json_of(size, rng),
        "wide characters.gltf": lambda size, rng: (
            json.dumps({"a": "\U0001f600" * (size // 4)}, ensure_ascii=False).encode()
        ),
        "embedded.gltf": gltf_embedded,
        "nodes.gltf": gltf_nodes,
        "primitives.glb": gltf_primitives,
        "chunks.glb": glb_chunks,
        "indices.glb": glb_indices,
        "bytes.glb": glb_bytes,
        "meshes.g3d": g3d_meshes,
        "indices.g3d": g3d_indices,
        "polygon.pie": lambda size, rng: pie(1, size // 2),
        "short polygons.pie": lambda size, rng: pie(size // 12, 3),
        "points.pie": lambda size, rng: (
            b"PIE 2\nPOINTS %d\n" % (size // 6) + b"1 2 3\n" * (size // 6)
        ),
        "levels.pie": pie_levels,
        "newlines.pie": lambda size, rng: pie(1, 3) + rng.choice((b"\n", b" ", b" \n")) * size,
        "points.glb": lambda size, rng: glb_bytes(size, rng, mode=0),
    }  # fmt: skip


def off(faces: int, corners: int) -> bytes:
    each = b"%d" % corners + b" 0 1 2" * (corners // 3) + b" 0" * (corners % 3) + b"\n"
    return b"OFF\n3 %d 0\n0 0 0\n1 0 0\n0 1 0\n" % faces + each * faces


def obj(faces: int, corners: int) -> bytes:
    each = b"f" + b" 1 2 3" * (corners // 3) + b" 1" * (corners % 3) + b"\n"
    return b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + each * faces


def g3d(*meshes: bytes) -> bytes:
    return b"G3D" + struct.pack("<BHB", 4, len(meshes), 0) + b"".join(meshes)


def g3d_mesh(frames: int, vertices: bytes, indices: bytes) -> bytes:
    counts = frames, len(vertices) // 12 // max(frames, 1), len(indices) // 4
    return struct.pack("<64s3I8f2I", b"", *counts, *[0.0] * 8, 0, 0) + vertices * 2 + indices


def g3d_meshes(size: int, rng: random.Random) -> bytes:
    """Meshes that hold nothing, or a triangle."""
    whole = g3d_mesh(1, _TRIANGLE, struct.pack("<3I", 0, 1, 2))
    each = rng.choice((g3d_mesh(0, b"", b""), whole))
    return g3d(whole, *[each] * min(size // len(each), 65_534))


def g3d_indices(size: int, rng: random.Random) -> bytes:
    """Faces alone, or vertices alone."""
    if rng.random() < 0.5:
        return g3d(g3d_mesh(1, _TRIANGLE * (size // 72), struct.pack("<3I", 0, 1, 2)))
    return g3d(g3d_mesh(1, _TRIANGLE, struct.pack("<3I", 0, 1, 2) * (size // 12)))


def pie(polygons: int, corners: int) -> bytes:
    each = b"0 %d" % corners + b" 0 1 2" * (corners // 3) + b" 0" * (corners % 3) + b"\n"
    return b"PIE 2\nPOINTS 3\n0 0 0\n1 0 0\n0 1 0\nPOLYGONS %d\n" % polygons + each * polygons


def pie_levels(size: int, rng: random.Random) -> bytes:
    """Levels that hold nothing, or a triangle, or no end of them."""
    each = rng.choice((b"POINTS 0\nPOLYGONS 0\n", b"POINTS 0\n", pie(1, 3)[6:]))
    most = rng.choice((4_999, size))
    return pie(1, 3) + each * min(size // len(each), most)


def stl_text(size: int, rng: random.Random, solids: bool = True) -> bytes:
    facet = b"facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
    facet += b"endloop\nendfacet\n"
    if rng.random() < 0.5:
        facet = facet.replace(b"\n", b" ")
    if not solids:
        return b"solid a\n" + facet * (size // len(facet)) + b"endsolid a\n"
    unit = b"solid\n" + facet * rng.choice((0, 1)) + b"endsolid\n"
    return b"solid\n" + facet + b"endsolid\n" + unit * (size // len(unit))


def stl_binary(size: int, rng: random.Random) -> bytes:
    row = bytes(12) + _TRIANGLE + bytes(2)
    return bytes(80) + struct.pack("<I", size // 50) + row * (size // 50)


def json_of(size: int, rng: random.Random) -> bytes:
    """An array of as little as possible."""
    each = rng.choice((b"[],", b"{},", b"0,", b'"",', b"[[]],", b'{"a":0},', b"0.5,", b'"ab",'))
    return b'{"nodes":[' + each * (size // len(each)) + b"0]}"


def document(**parts: object) -> dict:
    """A glTF of one triangle; `parts` replace its own."""
    base = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36}],
    }
    return {**base, **parts}


def glb(parts: dict, binary: bytes) -> bytes:
    text = json.dumps(parts, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", len(binary), 0x004E4942) + binary
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def gltf_embedded(size: int, rng: random.Random) -> bytes:
    """A buffer within the text."""
    count = size // 16 // 3 * 3
    buffers = [{"byteLength": 12 * count, "uri": "data:;base64," + "AACA" * (4 * count)}]
    accessors = [{"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3"}]
    views = [{"buffer": 0, "byteLength": 12 * count}]
    parts = document(buffers=buffers, accessors=accessors, bufferViews=views)
    return json.dumps(parts).encode()


def gltf_nodes(size: int, rng: random.Random) -> bytes:
    """Nodes with nothing to them, or all with one mesh; below the scene, or in a chain."""
    kind = rng.choice(("empty", "mesh", "chain"))
    if kind == "chain":
        nodes = [{"children": [k + 1]} for k in range(size // 20)] + [{"mesh": 0}]
        scenes = [{"nodes": [0]}]
    else:
        node = {} if kind == "empty" else {"mesh": 0}
        count = size // (9 if kind == "empty" else 17)
        nodes = [node] * count
        scenes = [{"nodes": list(range(count))}]
    uri = "data:;base64,AAAAAAAAAAAAAAAAAACAPwAAAAAAAAAAAAAAAAAAgD8AAAAA"
    parts = document(nodes=nodes, scenes=scenes, buffers=[{"byteLength": 36, "uri": uri}])
    return json.dumps(parts, separators=(",", ":")).encode()


def gltf_primitives(size: int, rng: random.Random) -> bytes:
    """Many primitives of one mesh, which nodes place again and again."""
    primitive = {"attributes": {"POSITION": 0}}
    primitives = [primitive] * (size // 60)
    nodes = [{"mesh": 0}] * (size // 60)
    parts = document(
        meshes=[{"primitives": primitives}],
        nodes=nodes,
        scenes=[{"nodes": list(range(len(nodes)))}],
    )
    return glb(parts, _TRIANGLE)


def glb_chunks(size: int, rng: random.Random) -> bytes:
    """Chunks that hold nothing, of one kind or of many."""
    whole = glb(document(), _TRIANGLE)[12:]
    kinds = range(7, 7 + (size // 8 if rng.random() < 0.5 else 1))
    empty = b"".join(struct.pack("<II", 0, kind) for kind in kinds)
    body = whole + empty * (size // len(empty))
    return b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body


def glb_indices(size: int, rng: random.Random) -> bytes:
    """One buffer of indices for several primitives, as triangles, a strip or a fan."""
    code, width = rng.choice(((5121, 1), (5123, 2), (5125, 4)))
    count = size // width
    mode = rng.choice((4, 5, 6))
    primitive = {"attributes": {"POSITION": 0}, "indices": 1, "mode": mode}
    parts = document(
        meshes=[{"primitives": [primitive] * rng.choice((1, 3))}],
        accessors=[
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": code, "count": count, "type": "SCALAR"},
        ],
        bufferViews=[
            {"buffer": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": width * count},
        ],
    )
    return glb(parts, _TRIANGLE + (np.arange(count) % 3).astype(f"<u{width}").tobytes())


def glb_bytes(size: int, rng: random.Random, mode: int = 4) -> bytes:
    """Positions of few bytes, as triangles that share none, or as mere points."""
    code, kind = rng.choice(((5121, "u1"), (5122, "<i2"), (5126, "<f4")))
    row = 3 * np.dtype(kind).itemsize
    count = size // row // 3 * 3
    accessor = {"bufferView": 0, "componentType": code, "count": count, "type": "VEC3"}
    if code != 5126:
        accessor["normalized"] = rng.random() < 0.5
    parts = document(
        accessors=[accessor],
        bufferViews=[{"buffer": 0, "byteLength": row * count}],
        meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "mode": mode}]}],
    )
    rows = np.arange(3 * count) % 7 % 3
    return glb(parts, rows.astype(kind).tobytes())
