"""Reads triangle meshes, including those of the games and simulators that open corpora come from.

PMD (0 A.D.) and AC3D (FlightGear) are parsed here, common formats by `cfr_jax.io`.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from cfr_jax.data.making.mesh_formats import mesh_formats
from cfr_jax.geometry import motions
from cfr_jax.io.cloud import as_float64
from cfr_jax.io.files import read_shape
from cfr_jax.io.mesh import Mesh, fan_triangles
from cfr_jax.runtime.messages import shown

_PMD_START = struct.Struct("<4sIIII")  # magic, version, size of the rest, vertices, texture sets
_PMD_COUNT = struct.Struct("<I")
_DEEPEST = 100  # levels of objects within objects in AC3D


def parse_pmd(data: bytes, name: str) -> Mesh:
    """Parses PMD, version 4, in the rest pose; bones are left out.

    The files wind most faces clockwise, so each face is wound to agree with the normals of its
    vertices. Raises ValueError, beginning with `name`, for a damaged file.
    """
    if len(data) < _PMD_START.size:
        raise ValueError(f"{name}: got {len(data)} bytes, wanted a PMD file with a header of 20")
    mark, version, _, count, sets = _PMD_START.unpack_from(data)
    if mark != b"PSMD" or version != 4:
        raise ValueError(f"{name}: starts with {mark!r} version {version}, wanted b'PSMD' 4")
    row = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("rest", "V", 8 * sets + 20)])
    end = _PMD_START.size + count * row.itemsize
    if end + _PMD_COUNT.size > len(data):
        raise ValueError(f"{name}: ends within its {count} vertices")
    rows = np.frombuffer(data, row, count, _PMD_START.size)
    (faces,) = _PMD_COUNT.unpack_from(data, end)
    start = end + _PMD_COUNT.size
    if start + 6 * faces > len(data):
        raise ValueError(f"{name}: ends within its {faces} faces")
    triangles = np.frombuffer(data, "<u2", 3 * faces, start).reshape(-1, 3).astype(np.int64)
    if faces and triangles.max() >= count:
        raise ValueError(f"{name}: a face names vertex {triangles.max()} of {count}")
    vertices, normals = as_float64(rows["position"]), as_float64(rows["normal"])
    return Mesh(vertices, _turned(vertices, triangles, normals), name)


def _turned(
    vertices: Float64[np.ndarray, "v 3"],
    triangles: Int64[np.ndarray, "t 3"],
    normals: Float64[np.ndarray, "v 3"],
) -> Int64[np.ndarray, "t 3"]:
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    wanted = normals[triangles].sum(axis=1)
    with np.errstate(invalid="ignore", over="ignore"):  # damaged numbers are removed later
        inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), wanted) < 0
    return np.where(inward[:, None], triangles[:, ::-1], triangles)


def parse_ac3d(data: bytes, name: str) -> Mesh:
    """Parses AC3D: all polygons of all objects, placed by the object tree.

    Lines are left out because they have no area. Raises ValueError, beginning with `name` and the
    line, for a damaged file.
    """
    text = data.decode("latin1")
    if not text.startswith("AC3D"):
        raise ValueError(f"{name}: starts with {text[:8]!r}, wanted 'AC3D'")
    # Not `splitlines`, which takes some Latin-1 characters as ends of lines.
    reader = _Ac3d(text.replace("\r\n", "\n").removesuffix("\n").split("\n"), name)
    reader.read_object(np.eye(4))
    vertices = np.concatenate(reader.vertices) if reader.vertices else np.zeros((0, 3))
    sizes = np.array([len(polygon) for polygon in reader.polygons], np.int64)
    corners = np.array([corner for polygon in reader.polygons for corner in polygon], np.int64)
    return Mesh(vertices, fan_triangles(corners, sizes), name)


class _Ac3d:
    """The lines of an AC3D file, read once from top to bottom."""

    def __init__(self, lines: list[str], name: str):
        self._lines, self._name = lines, name
        self._at = 1  # after the magic line
        self._seen = 0
        self.vertices: list[np.ndarray] = []
        self.polygons: list[list[int]] = []  # corners, numbered over all objects

    def read_object(self, parent: Float64[np.ndarray, "4 4"], depth: int = 0) -> None:
        """Reads the next OBJECT and its children. MATERIAL lines before it are skipped."""
        if depth > _DEEPEST:
            self._fail(f"wanted objects within at most {_DEEPEST} others")
        # Some exporters drop an object without reducing the number of children. The file then ends
        # early.
        if not any(self._lines[self._at :]):
            return
        while (words := self._words())[:1] != ["OBJECT"]:
            if words[:1] != ["MATERIAL"] and words:
                self._fail(f"wanted OBJECT or MATERIAL, got {words[0]!r}")
        local = np.eye(4)
        first = count = 0
        while True:
            match self._words():
                case ["rot", *numbers] if len(numbers) == 9:
                    # A row in the file is the image of an axis of the object.
                    local[:3, :3] = self._floats(numbers).reshape(3, 3).T
                case ["loc", *numbers] if len(numbers) == 3:
                    local[:3, 3] = self._floats(numbers)
                case ["data", length]:
                    self._skip_text(self._count(length))
                case ["numvert", number]:
                    first, count = self._seen, self._count(number)
                    points = [self._floats((self._words() + [""] * 3)[:3]) for _ in range(count)]
                    self._place(np.array(points).reshape(-1, 3), parent @ local)
                case ["numsurf", number]:
                    for _ in range(self._count(number)):
                        self._read_surface(first, count)
                case ["kids", number]:
                    for _ in range(self._count(number)):
                        self.read_object(parent @ local, depth + 1)
                    return
                case ["OBJECT", *_]:
                    self._fail("wanted 'kids' before the next OBJECT")
                case _:  # name, texture, crease, ...: they do not affect the shape
                    pass

    def _place(self, points: np.ndarray, motion: Float64[np.ndarray, "4 4"]) -> None:
        with np.errstate(invalid="ignore", over="ignore"):  # damaged numbers are removed later
            self.vertices.append(motions.apply(motion, points))
        self._seen += len(points)

    def _read_surface(self, first: int, count: int) -> None:
        kind = 0
        while True:
            match self._words():
                case ["SURF", flags]:
                    kind = self._count(flags, base=0) & 0xF
                case ["mat", _]:
                    pass
                case ["refs", number]:
                    corners = [
                        self._count((self._words() or [""])[0]) for _ in range(self._count(number))
                    ]
                    break
                case words:
                    self._fail(f"wanted SURF, mat or refs, got {' '.join(words)!r}")
        if any(corner >= count for corner in corners):
            self._fail(f"a surface names vertex {max(corners)} of {count}")
        if kind == 0:
            self.polygons.append([first + corner for corner in corners])

    def _skip_text(self, length: int) -> None:
        """Skips free text of `length` characters, which may contain line ends."""
        while True:
            length -= len(self._line()) + 1
            if length < 0:
                return

    def _line(self) -> str:
        if self._at >= len(self._lines):
            raise ValueError(f"{self._name}: ends too early, in line {self._at}")
        self._at += 1
        return self._lines[self._at - 1]

    def _words(self) -> list[str]:
        return self._line().split()

    def _floats(self, words: list[str]) -> Float64[np.ndarray, " n"]:
        try:
            return np.array([float(word) for word in words])
        except ValueError:
            self._fail(f"wanted {len(words)} numbers, got {' '.join(words)!r}")
            raise  # never reached

    def _count(self, word: str, base: int = 10) -> int:
        try:
            number = int(word, base)
        except ValueError:
            number = -1
        if number < 0:
            self._fail(f"wanted a count or an index, got {word!r}")
        return number

    def _fail(self, message: str) -> None:
        raise ValueError(f"{self._name}: line {self._at}: {message}")


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
