"""Meshes and packages made by hand, in the formats that open corpora come in."""

import io
import struct
import tarfile
import zipfile
from pathlib import Path

import numpy as np

from cfr_jax.io.mesh import Mesh


def knot(
    seed: int, vertices: int = 30, scale: tuple = (1.0, 0.7, 0.5), corners: bool = False
) -> Mesh:
    """A lumpy shape: the hull of random points, or with all of them for corners."""
    from scipy.spatial import ConvexHull

    points = np.random.default_rng(seed).normal(size=(vertices, 3))
    if corners:
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    points *= scale
    hull = ConvexHull(points)
    triangles = hull.simplices.astype(np.int64)
    a, b, c = (points[triangles[:, corner]] for corner in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    triangles[inward] = triangles[inward, ::-1]
    return Mesh(points, triangles, f"knot {seed}")


def off(mesh: Mesh) -> str:
    lines = ["OFF", f"{len(mesh.vertices)} {len(mesh.triangles)} 0"]
    lines += [" ".join(f"{x!r}" for x in vertex.tolist()) for vertex in mesh.vertices]
    lines += ["3 " + " ".join(map(str, triangle)) for triangle in mesh.triangles.tolist()]
    return "\n".join(lines) + "\n"


def obj(mesh: Mesh) -> str:
    lines = ["v " + " ".join(f"{x!r}" for x in vertex.tolist()) for vertex in mesh.vertices]
    lines += [
        "f " + " ".join(f"{i + 1}/1/1" for i in triangle) for triangle in mesh.triangles.tolist()
    ]
    return "\n".join(lines) + "\n"


def ac3d(mesh: Mesh, *, location: tuple[float, float, float] = (0, 0, 0)) -> str:
    lines = ["AC3Db", 'MATERIAL "m" rgb 1 1 1  trans 0', "OBJECT world", "kids 1"]
    lines += ["OBJECT poly", 'name "knot"', "loc {} {} {}".format(*location)]
    lines += [f"numvert {len(mesh.vertices)}"]
    lines += [" ".join(f"{x!r}" for x in vertex.tolist()) for vertex in mesh.vertices]
    lines += [f"numsurf {len(mesh.triangles)}"]
    for triangle in mesh.triangles.tolist():
        lines += ["SURF 0x10", "mat 0", "refs 3"] + [f"{i} 0 0" for i in triangle]
    return "\n".join([*lines, "kids 0", ""])


def pmd(mesh: Mesh, normals: np.ndarray, sets: int = 1) -> bytes:
    rest = np.zeros((len(mesh.vertices), 8 * sets + 20), np.uint8)
    rows = np.hstack(
        [mesh.vertices.astype("<f4").view(np.uint8), normals.astype("<f4").view(np.uint8), rest]
    )
    body = struct.pack("<II", len(rows), sets) + rows.tobytes()
    body += struct.pack("<I", len(mesh.triangles)) + mesh.triangles.astype("<u2").tobytes()
    body += struct.pack("<II", 0, 0)  # no bones, no attachment points
    return b"PSMD" + struct.pack("<II", 4, len(body)) + body


def sh3f(path: Path, pieces: dict[str, tuple[str, str, Mesh]]) -> None:
    """A furniture library: identifier → (name, category, mesh)."""
    lines = ["# a library", "id=Test#Library"]
    with zipfile.ZipFile(path, "w") as archive:
        for index, (identifier, (name, category, mesh)) in enumerate(pieces.items(), 1):
            entry = {
                "id": identifier,
                "name": name,
                "category": category,
                "model": f"/models/{index}.obj",
                "width": "200",
                "depth": "50.5",
                "height": "100",
            }
            lines += [f"{key}#{index}={value}" for key, value in entry.items()]
            archive.writestr(f"models/{index}.obj", obj(mesh))
        text = "\n".join(lines)
        archive.writestr("PluginFurnitureCatalog.properties", text.encode("latin1"))


def deb(path: Path, files: dict[str, bytes], packed: str = "xz") -> None:
    """A Debian package with these files."""
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode=f"w:{packed}") as tar:
        for name, content in files.items():
            member = tarfile.TarInfo(f"./{name}")
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
    members = {"debian-binary": b"2.0\n", "control.tar.xz": b"odd", f"data.tar.{packed}": None}
    with open(path, "wb") as stream:
        stream.write(b"!<arch>\n")
        for name, content in members.items():
            content = data.getvalue() if content is None else content
            header = f"{name:<16}{0:<12}{0:<6}{0:<6}{'100644':<8}{len(content):<10}`\n"
            stream.write(header.encode() + content + b"\n" * (len(content) % 2))
