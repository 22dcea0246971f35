"""Small files of every format that `cfr_jax.io` reads, written by other programs' libraries or
byte by byte here, all of the same points or of the same surface."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import laspy
import numpy as np
import plyfile
import trimesh
from game_samples import g3d, pie

COUNT = 60


def points() -> np.ndarray:
    """(60, 3) points whose coordinates float32, integers of a millimeter and text hold alike."""
    return np.random.default_rng(7).integers(-4096, 4096, (COUNT, 3)) / 1024.0


def normals() -> np.ndarray:
    directions = np.random.default_rng(8).normal(size=(COUNT, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def surface() -> trimesh.Trimesh:
    """A box about (1, 2, 3) of sides 2, 4 and 6, faces outwards."""
    return trimesh.creation.box(
        extents=(2.0, 4.0, 6.0), transform=trimesh.transformations.translation_matrix((1, 2, 3))
    )


def write_clouds(folder: Path) -> dict[str, Path]:
    """Clouds of `points()`, by what is special about each file."""
    files = {}

    def put(name: str, data: bytes) -> None:
        files[name] = folder / name
        files[name].write_bytes(data)

    xyz, unit = points(), normals()
    rows = np.empty(COUNT, [(c, "f4") for c in ("x", "y", "z", "nx", "ny", "nz")] + [("red", "u1")])
    for axis in range(3):
        rows["xyz"[axis]] = xyz[:, axis]
        rows["n" + "xyz"[axis]] = unit[:, axis]
    for name, text, order in (("text", True, "="), ("little", False, "<"), ("big", False, ">")):
        element = plyfile.PlyElement.describe(rows, "vertex")
        files[f"{name}.ply"] = folder / f"{name}.ply"
        plyfile.PlyData([element], text=text, byte_order=order).write(files[f"{name}.ply"])

    put("text.pcd", pcd("ascii"))
    put("binary.pcd", pcd("binary"))
    put("compressed.pcd", pcd("binary_compressed"))
    put("plain.xyz", b"# a comment\n" + table_text(xyz))
    put("normals.txt", table_text(np.hstack([xyz, unit])))
    put("named.csv", b"id,z,y,x\n" + table_text(np.c_[np.arange(COUNT), xyz[:, ::-1]], ","))
    np.save(folder / "plain.npy", np.hstack([xyz, unit]))
    np.savez(folder / "stored.npz", points=xyz, normals=unit)
    np.savez_compressed(folder / "deflated.npz", points=xyz.astype(np.float32))
    put("velodyne.bin", np.c_[xyz, np.ones(COUNT)].astype("<f4").tobytes())
    for name in ("plain.npy", "stored.npz", "deflated.npz"):
        files[name] = folder / name
    for layout, version in ((0, "1.2"), (3, "1.3"), (6, "1.4"), (7, "1.4")):
        for suffix in ("las", "laz"):
            name = f"format{layout}.{suffix}"
            files[name] = folder / name
            write_las(files[name], xyz, layout, version)
    return files


def table_text(table: np.ndarray, delimiter: str = " ") -> bytes:
    return "".join(delimiter.join(f"{v:.17g}" for v in row) + "\n" for row in table).encode()


def write_las(path: Path, xyz: np.ndarray, layout: int = 3, version: str = "1.2") -> None:
    header = laspy.LasHeader(point_format=layout, version=version)
    header.scales, header.offsets = [1 / 1024] * 3, [0.5, 0.25, 0.125]
    header.vlrs.append(laspy.VLR("somebody", 7, "a record to step over", b"1234567"))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = xyz.T
    cloud.write(path)


def pcd(storage: str) -> bytes:
    """A PCD as PCL writes it, with padding, normals and a field of another type."""
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        "FIELDS x y z _ normal_x normal_y normal_z label\nSIZE 4 4 4 1 4 4 4 4\n"
        f"TYPE F F F U F F F U\nCOUNT 1 1 1 4 1 1 1 1\nWIDTH {COUNT}\nHEIGHT 1\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {COUNT}\nDATA {storage}\n"
    ).encode()
    labels = np.arange(COUNT)
    if storage == "ascii":
        return header + table_text(np.c_[points(), np.zeros((COUNT, 4)), normals(), labels])
    columns = [*points().T.astype("<f4"), np.zeros((COUNT, 4), "u1")]
    columns += [*normals().T.astype("<f4"), labels.astype("<u4")]
    if storage == "binary":
        rows = [b"".join(column[row].tobytes() for column in columns) for row in range(COUNT)]
        return header + b"".join(rows)
    raw = b"".join(column.tobytes() for column in columns)
    packed = lzf(raw)
    return header + struct.pack("<II", len(packed), len(raw)) + packed


def lzf(raw: bytes) -> bytes:
    """A greedy LZF compressor, with repetitions that overlap themselves where there are any."""
    out, literals, position = bytearray(), bytearray(), 0

    def flush() -> None:
        for start in range(0, len(literals), 32):
            run = literals[start : start + 32]
            out.append(len(run) - 1)
            out.extend(run)
        literals.clear()

    while position < len(raw):
        start = raw.rfind(raw[position : position + 3], max(0, position - 8191), position + 2)
        if start < 0 or start >= position or position + 3 > len(raw):
            literals.append(raw[position])
            position += 1
            continue
        length = 3
        while (
            length < 264
            and position + length < len(raw)
            and raw[start + length] == raw[position + length]
        ):
            length += 1
        flush()
        distance, code = position - start - 1, length - 2
        out.append((min(code, 7) << 5) | (distance >> 8))
        if code >= 7:
            out.append(code - 7)
        out.append(distance & 255)
        position += length
    flush()
    return bytes(out)


def write_meshes(folder: Path) -> dict[str, Path]:
    """The box of `surface()`, by what is special about each file."""
    files = {}

    def put(name: str, data: bytes) -> None:
        files[name] = folder / name
        files[name].write_bytes(data)

    box = surface()
    for name, encoding in (("box_text.ply", "ascii"), ("box.ply", "binary")):
        put(name, box.export(file_type="ply", encoding=encoding))
    put("mixed.ply", polygon_ply())
    put("mixed_text.ply", polygon_ply(text=True))
    put("box.off", box.export(file_type="off").encode())
    put("box.obj", box.export(file_type="obj", include_normals=True).encode())
    put("box.stl", box.export(file_type="stl"))
    put("box_text.stl", box.export(file_type="stl_ascii").encode())
    put("box.glb", trimesh.Scene(box).export(file_type="glb"))
    put("moved.gltf", moved_gltf())
    put("box.g3d", g3d(box.vertices, box.faces))
    put("box.pie", pie(corners(), polygons()))
    return files


def polygons() -> list[list[int]]:
    """The box's six sides: a fan of two triangles, and five quadrilaterals (corner k is at the
    bits x=1, y=2, z=4 of k)."""
    return [[0, 2, 3], [0, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2],
            [1, 3, 7, 5]]  # fmt: skip


def corners() -> np.ndarray:
    bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
    return bits * (2.0, 4.0, 6.0)


def polygon_ply(text: bool = False) -> bytes:
    """The box as polygons of different sizes, with a second list and an element before them."""
    sides = polygons()
    header = (
        f"ply\nformat {'ascii' if text else 'binary_big_endian'} 1.0\ncomment made by hand\n"
        "element camera 1\nproperty float view_px\nproperty list uchar short view\n"
        "element vertex 8\nproperty double x\nproperty double y\nproperty double z\n"
        f"element face {len(sides)}\nproperty uchar flags\n"
        "property list uchar int vertex_indices\nproperty list uint float texcoord\nend_header\n"
    ).encode()
    if text:
        lines = ["1.5 2 3 4", *(" ".join(map(str, row)) for row in corners())]
        lines += [f"9 {len(side)} {' '.join(map(str, side))} 2 0.5 0.25" for side in sides]
        return header + "\n".join(lines).encode() + b"\n"
    body = struct.pack(">fBhh", 1.5, 2, 3, 4) + corners().astype(">f8").tobytes()
    for side in sides:
        body += struct.pack(f">BB{len(side)}iIff", 9, len(side), *side, 2, 0.5, 0.25)
    return header + body


def moved_gltf() -> bytes:
    """The box as a unit cube that nodes scale, turn and move into place, buffers within."""
    import base64

    cube = trimesh.creation.box()
    vertices = cube.vertices.astype("<f4").tobytes()
    data = vertices + cube.faces.astype("<u2").tobytes()
    half = 0.5**0.5
    return json.dumps(
        {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [
                {"children": [1], "translation": [1, 2, 3]},
                # A quarter turn about z: the side of 4 along x comes to lie along y.
                {"mesh": 0, "rotation": [0, 0, half, half], "scale": [4, 2, 6]},
            ],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
            "accessors": [
                {"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3"},
                {"bufferView": 1, "componentType": 5123, "count": 36, "type": "SCALAR"},
            ],
            "bufferViews": [
                {"buffer": 0, "byteLength": 96},
                {"buffer": 0, "byteOffset": 96, "byteLength": 72},
            ],
            "buffers": [
                {
                    "byteLength": len(data),
                    "uri": "data:application/octet-stream;base64,"
                    + base64.b64encode(data).decode(),
                }
            ],
        }
    ).encode()
