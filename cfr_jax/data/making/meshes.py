"""Reads triangle meshes, including those of the games and simulators that open corpora come from.

PMD (0 A.D.) is parsed here, AC3D (FlightGear) beside, and common formats by `cfr_jax.io`.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from cfr_jax.data.making.mesh_formats import mesh_formats
from cfr_jax.io.budget import POINT, check_surface
from cfr_jax.io.cloud import CloudFileError, as_float64
from cfr_jax.io.files import read_shape
from cfr_jax.io.mesh import Mesh
from cfr_jax.runtime.messages import shown

_PMD_START = struct.Struct("<4sIIII")  # magic, version, size of the rest, vertices, texture sets
_PMD_ROW = 44  # bytes of a vertex without texture coordinates
_PMD_COUNT = struct.Struct("<I")
_AT_ONCE = 1 << 16  # triangles, so that memory stays near what the mesh itself takes


def parse_pmd(data: bytes, name: str) -> Mesh:
    """Parses PMD, version 4, in the rest pose; bones are left out.

    The files wind most faces clockwise, so each face is wound to agree with the normals of its
    vertices. Raises CloudFileError for a damaged file.
    """
    if len(data) < _PMD_START.size:
        raise CloudFileError(f"got {len(data)} bytes, wanted a PMD file with a header of 20")
    mark, version, _, count, sets = _PMD_START.unpack_from(data)
    if mark != b"PSMD" or version != 4:
        raise CloudFileError(f"starts with {mark!r} version {version}, wanted b'PSMD' 4")
    end = _PMD_START.size + count * (_PMD_ROW + 8 * sets)
    if end + _PMD_COUNT.size > len(data):
        raise CloudFileError(f"ends within its {count} vertices")
    rest = _PMD_ROW - 24 + 8 * (sets if count else 0)
    row = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("rest", f"V{rest}")])
    rows = np.frombuffer(data, row, count, _PMD_START.size)
    (faces,) = _PMD_COUNT.unpack_from(data, end)
    start = end + _PMD_COUNT.size
    if start + 6 * faces > len(data):
        raise CloudFileError(f"ends within its {faces} faces")
    check_surface(count, faces, len(data), taken=POINT * count)
    triangles = np.frombuffer(data, "<u2", 3 * faces, start).reshape(-1, 3).astype(np.int64)
    if faces and triangles.max() >= count:
        raise CloudFileError(f"a face names vertex {triangles.max()} of {count}")
    vertices, normals = as_float64(rows["position"]), as_float64(rows["normal"])
    for begin in range(0, faces, _AT_ONCE):
        _turn(vertices, triangles[begin : begin + _AT_ONCE], normals)
    return Mesh(vertices, triangles, name)


def _turn(
    vertices: Float64[np.ndarray, "v 3"],
    triangles: Int64[np.ndarray, "t 3"],
    normals: Float64[np.ndarray, "v 3"],
) -> None:
    """Turns triangles over, in place, that do not wind as the normals of their corners say."""
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    wanted = normals[triangles].sum(axis=1)
    with np.errstate(invalid="ignore", over="ignore"):  # damaged numbers are removed later
        inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), wanted) < 0
    triangles[inward] = triangles[inward, ::-1]


def read_mesh(path: Path) -> Mesh:
    """Reads the triangles of a file. Its suffix gives the format, one of `mesh_formats`.

    Raises ValueError if the file cannot be read or holds points but no faces. The message does not
    name the file, so that it is the same wherever the file lies.
    """
    try:
        mesh = read_shape(path, mesh_formats())
    except ValueError as error:
        why = str(error).removeprefix(f"{shown(path)}: ").removeprefix(f"{path.name}: ")
        raise ValueError(why) from error
    if not isinstance(mesh, Mesh):
        raise ValueError("got a point cloud, wanted a mesh with faces")
    return mesh
