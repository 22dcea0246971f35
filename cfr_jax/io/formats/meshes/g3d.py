"""G3D, version 4, the models of the game Megaglest: meshes with a block of positions a frame."""

from __future__ import annotations

import struct

import numpy as np

from cfr_jax.io.budget import check_surface
from cfr_jax.io.cloud import CloudFileError
from cfr_jax.io.mesh import Mesh

_START = struct.Struct("<3sBHB")  # mark, version, meshes, kind
# Name, frames, vertices, indices, colors, properties, and a bit for each texture.
_MESH = struct.Struct("<64s3I8f2I")
_TEXTURE, _VERTEX, _COORDINATES, _INDEX = 64, 24, 8, 4  # bytes


def parse(data: bytes, name: str) -> Mesh:
    """All meshes of the file as one, in their first frame; y up.

    Normals are left out: those of the faces are those of the surface.
    """
    if len(data) < _START.size or data[:3] != b"G3D":
        raise CloudFileError(f"byte 0: starts with {data[:3]!r}, wanted b'G3D' and a header")
    _, version, meshes, _ = _START.unpack_from(data)
    if version != 4:
        raise CloudFileError(f"byte 3: version {version}, wanted 4")
    vertices: list[np.ndarray] = []
    triangles: list[np.ndarray] = []
    at, seen, faces = _START.size, 0, 0
    for mesh in range(meshes):
        points, corners, at = _read_mesh(data, at, mesh)
        check_surface(seen + len(points), faces + len(corners), len(data))
        if len(corners) and corners.max() >= len(points):
            raise CloudFileError(
                f"mesh {mesh}: a face names vertex {corners.max()}, wanted 0 to {len(points) - 1}"
            )
        vertices.append(points)
        triangles.append(corners.astype(np.int64) + seen)
        seen, faces = seen + len(points), faces + len(corners)
    if at != len(data):
        raise CloudFileError(f"byte {at}: {len(data) - at} bytes stand behind {meshes} meshes")
    if not seen:
        raise CloudFileError(f"holds no vertices in {meshes} meshes, wanted at least three")
    return Mesh(np.concatenate(vertices), np.concatenate(triangles), name)


def _read_mesh(data: bytes, at: int, mesh: int) -> tuple[np.ndarray, np.ndarray, int]:
    """The vertices (v, 3) of the first frame, the faces (t, 3), and where the next mesh begins."""
    if at + _MESH.size > len(data):
        raise CloudFileError(f"byte {at}: ends before mesh {mesh}")
    _, frames, vertices, indices, *_, textures = _MESH.unpack_from(data, at)
    start = at + _MESH.size + _TEXTURE * textures.bit_count()
    # Positions of all frames, then the normals of all frames, then texture coordinates.
    faces = start + frames * vertices * _VERTEX + (vertices * _COORDINATES if textures else 0)
    end = faces + indices * _INDEX
    if end > len(data):
        raise CloudFileError(
            f"byte {at}: mesh {mesh} has {frames} frames of {vertices} vertices and {indices} "
            f"indices, which end at byte {end} of {len(data)}"
        )
    if indices % 3 or (vertices and not frames):
        raise CloudFileError(
            f"byte {at}: mesh {mesh} has {frames} frames and {indices} indices, wanted at least "
            "one frame and a multiple of three"
        )
    points = np.frombuffer(data, "<f4", 3 * vertices, start).reshape(-1, 3)
    corners = np.frombuffer(data, "<u4", indices, faces).reshape(-1, 3)
    return points, corners, end
