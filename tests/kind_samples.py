"""Files as programs really write them, all of `io_samples.points()`, by what is odd about each.

Each sample is a file name and its bytes; `io_samples` has the plain ones, `text_samples` the text.
"""

from __future__ import annotations

import io
import json
import struct

import numpy as np
from io_samples import COUNT, surface
from text_samples import LABELS, LINES, ROWS, XYZ, text_kinds


def ply(names: str = "x y z", more: str = "", *, order: str = "binary_little_endian") -> bytes:
    """A PLY header for the points, and their rows in doubles behind it."""
    head = f"ply\nformat {order} 1.0\nelement vertex {COUNT}\n"
    head += "".join(f"property double {name}\n" for name in names.split())
    body = ROWS.encode() if order == "ascii" else XYZ.astype("<f8").tobytes()
    return f"{head}{more}end_header\n".encode() + body


def ply_of_rows(head: str, rows: list[bytes]) -> bytes:
    start = f"ply\nformat binary_little_endian 1.0\nelement vertex {COUNT}\n"
    return f"{start}{head}end_header\n".encode() + b"".join(rows)


def ply_kinds() -> dict[str, tuple[str, bytes]]:
    """PLY of other writers than plyfile."""
    faces = "element face 0\nproperty list uchar int vertex_indices\n"
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    listed = [struct.pack(f"<3fB{k % 3}h", *row, k % 3, *range(k % 3)) for k, row in enumerate(XYZ)]
    equal = [struct.pack("<B2h3f", 2, 5, 6, *row) for row in XYZ]
    odd = [struct.pack("<3d?qe", *row, True, 1 << 40, 0.5) for row in XYZ]
    twice = [struct.pack("<3f2B", *row, 1, 2) for row in XYZ]
    text = ply(order="ascii")
    list_lines = "".join(
        f"{line} {k % 3}{' 7' * (k % 3)}\n" for k, line in enumerate(LINES)
    ).encode()
    doubles = "".join(f"property double {axis}\n" for axis in "xyz")
    return {
        "byte order mark": ("a.ply", b"\xef\xbb\xbf" + text),
        "blanks behind words": ("a.ply", text.replace(b"ply\n", b"ply \n").replace(
            b"end_header", b"end_header  ").replace(b"ascii 1.0", b"ascii 1.0 ")),
        "blanks behind words, binary": ("a.ply", ply().replace(b"end_header", b"end_header ")),
        "Windows": ("a.ply", text.replace(b"\n", b"\r\n")),
        "upper case": ("a.ply", ply("X Y Z")),
        "empty faces": ("a.ply", ply(more=faces)),
        "empty faces, text": ("a.ply", ply(more=faces, order="ascii")),
        "types of others": ("a.ply", ply_of_rows(
            doubles + "property bool valid\nproperty int64 stamp\nproperty float16 weight\n", odd)),
        "a name twice": ("a.ply", ply_of_rows(axes + "property uchar a\n" * 2, twice)),
        "lists behind points": ("a.ply", ply_of_rows(
            axes + "property list uchar short ids\n", listed)),
        "lists before points": ("a.ply", ply_of_rows(
            "property list uchar short ids\n" + axes, equal)),
        "lists, text": ("a.ply", ply(more="property list uchar int ids\n", order="ascii").partition(
            ROWS.encode())[0] + list_lines),
        "a row without a point": ("a.ply", text.replace(
            f"vertex {COUNT}".encode(), f"vertex {COUNT + 1}".encode()) + b"nan nan nan\n"),
        "format with a comment": ("a.ply", text.replace(b"ply\n", b"ply\nobj_info from x y z\n")),
    }  # fmt: skip


def pcd_kinds() -> dict[str, tuple[str, bytes]]:
    """PCD of other writers than PCL."""
    head = (
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {COUNT}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {COUNT}\n"
    )
    text, rows = f"{head}DATA ascii\n{ROWS}", XYZ.astype("<f4").tobytes()
    wide = head.replace(f"WIDTH {COUNT}", f"WIDTH {COUNT * 2}")
    cells = {
        "upper case": text.replace("FIELDS x y z", "FIELDS X Y Z"),
        "lower case": text.replace("TYPE F F F", "TYPE f f f"),
        "version 0.5": text.replace("VERSION 0.7\nFIELDS", "VERSION .5\nCOLUMNS").replace(
            "COUNT 1 1 1\n", ""),
        "unknown entries": "# .PCD v.7\nSENSOR velodyne 64\n" + text,
        "width of another cloud": f"{wide}DATA ascii\n{ROWS}",
        "an infinite row": text.replace(f" {COUNT}\n", f" {COUNT + 1}\n") + "inf 1 2\n",
    }  # fmt: skip
    found = {key: ("a.pcd", value.encode()) for key, value in cells.items()}
    found["width of another cloud, binary"] = "a.pcd", f"{wide}DATA binary\n".encode() + rows
    return found


def array_kinds() -> dict[str, tuple[str, bytes]]:
    """NPY and NPZ as pipelines leave them, and scans of driving."""
    fields = [("time", "f8"), ("x", "f4"), ("y", "f4"), ("z", "f4"), ("ring", "u2")]
    structured = np.zeros(COUNT, fields)
    for k, axis in enumerate("xyz"):
        structured[axis] = XYZ[:, k]
    holes = np.concatenate([XYZ, [[np.nan, 0, 0]]])
    rings = np.c_[XYZ, LABELS % 200, LABELS % 32].astype("<f4")
    kitti = np.c_[XYZ, np.linspace(0, 1, COUNT)].astype("<f4")
    return {
        "structured": ("a.npy", npy(structured)),
        "structured in a grid": ("a.npy", npy(structured.reshape(6, 10))),
        "a batch of one": ("a.npy", npy(XYZ[None])),
        "organized": ("a.npy", npy(XYZ.reshape(6, 10, 3))),
        "organized in Fortran's order": ("a.npy", npy(np.asfortranarray(XYZ.reshape(6, 10, 3)))),
        "a row without a point": ("a.npy", npy(holes)),
        "xyz": ("a.npz", npz(xyz=XYZ, label=LABELS)),
        "pc": ("a.npz", npz(pc=XYZ.astype("f4"), label=3)),
        "pcd": ("a.npz", npz(pcd=XYZ, color=XYZ)),
        "src alone": ("a.npz", npz(src=XYZ, transform=np.eye(4))),
        "x, y and z": ("a.npz", npz(x=XYZ[:, 0], y=XYZ[:, 1], z=XYZ[:, 2], t=LABELS)),
        "points in a grid": ("a.npz", npz(points=XYZ.reshape(6, 10, 3))),
        "KITTI": ("a.bin", kitti.tobytes()),
        "nuScenes": ("a.bin", rings.tobytes()),
        "nuScenes by name": ("a.pcd.bin", rings.tobytes()),
    }


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def npz(**arrays) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def mesh_kinds() -> dict[str, tuple[str, bytes]]:
    """Formats of meshes that hold points alone."""
    binary = XYZ.astype("<f4").tobytes()
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 0}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": COUNT, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": len(binary)}],
        "buffers": [{"byteLength": len(binary)}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", len(binary), 0x004E4942) + binary
    glb = b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks
    return {"points of glTF": ("a.glb", glb)}


def solids() -> bytes:
    """The box of `io_samples.surface()` as one solid of STL for each pair of its triangles."""
    box = surface()
    text = ""
    for k in range(0, 12, 2):
        text += f"solid side {k}\n"
        for face in box.faces[k : k + 2]:
            text += "facet normal 0 0 0\nouter loop\n"
            text += "".join("vertex {} {} {}\n".format(*box.vertices[c]) for c in face)
            text += "endloop\nendfacet\n"
        text += f"endsolid side {k}\n"
    return text.encode()


def all_kinds() -> dict[str, tuple[str, bytes]]:
    """All of them, by the format and what is odd."""
    groups = {
        "text": text_kinds(), "ply": ply_kinds(), "pcd": pcd_kinds(), "array": array_kinds(),
        "mesh": mesh_kinds(),
    }  # fmt: skip
    return {f"{group}: {key}": kinds[key] for group, kinds in groups.items() for key in kinds}
