"""glTF 2.0, as one file (GLB) or as JSON with its buffers beside or within it."""

from __future__ import annotations

import base64
import json
import os
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float64

from cfr_jax.io.budget import check_json, check_surface
from cfr_jax.io.cloud import CloudFileError, PointCloud
from cfr_jax.io.files import contents
from cfr_jax.io.formats.meshes.nodes import get, is_moved, placement
from cfr_jax.io.formats.meshes.primitives import POINTS, SURFACES, TRIANGLES, Primitive
from cfr_jax.io.mesh import Mesh
from cfr_jax.io.table import cloud_of_filled

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3}
_JSON_CHUNK, _BINARY_CHUNK = 0x4E4F534A, 0x004E4942
# What takes time however little it holds: nodes, and primitives, which take several times that.
_STEPS, _BYTES_OF_A_STEP, _STEPS_OF_A_PRIMITIVE = 20_000, 300, 5


def parse_glb(data: bytes, name: str, folder: Path) -> Mesh | PointCloud:
    """The triangles of the scene, each mesh placed as its nodes say; meters, y up, as in glTF.

    A scene that has points and no triangles is a cloud.
    """
    if data[:4] != b"glTF" or len(data) < 20:
        raise CloudFileError(f"byte 0: starts with {data[:4]!r}, wanted b'glTF' and a header")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2 or length > len(data):
        raise CloudFileError(
            f"byte 4: version {version}, {length} bytes; wanted version 2 and at most {len(data)}"
        )
    chunks: dict[int, memoryview] = {}
    whole = memoryview(data)
    position = 12
    while position + 8 <= length:
        size, kind = struct.unpack_from("<II", data, position)
        position += 8
        if position + size > length:
            raise CloudFileError(
                f"byte {position - 8}: a chunk of {size} bytes ends behind the file"
            )
        if kind in (_JSON_CHUNK, _BINARY_CHUNK):
            chunks.setdefault(kind, whole[position : position + size])
        position += size
    if _JSON_CHUNK not in chunks:
        raise CloudFileError("byte 12: wanted a chunk of JSON, found none")
    return _Scene(bytes(chunks[_JSON_CHUNK]), chunks.get(_BINARY_CHUNK), folder).shape(name)


def parse_gltf(data: bytes, name: str, folder: Path) -> Mesh | PointCloud:
    """As `parse_glb`; buffers are read from the file's own folder only."""
    return _Scene(data, None, folder).shape(name)


class _Scene:
    """The parts of a glTF document that say where triangles are."""

    def __init__(self, text: bytes, binary: memoryview | None, folder: Path) -> None:
        self.size = len(text) + len(binary or b"")
        check_json(text, self.size)
        try:
            self.document = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise CloudFileError(f"the JSON is damaged: {error}") from None
        if not isinstance(self.document, dict):
            raise CloudFileError("wanted a JSON object")
        self.folder = folder
        self.buffers: dict[int, bytes | memoryview] = {} if binary is None else {0: binary}
        self.steps = 0
        needed = get(self.document, "extensionsRequired", list, [])
        packed = [name for name in needed if "compression" in str(name)]
        if packed:
            raise CloudFileError(f"needs the extension {packed[0]!r}, wanted an uncompressed mesh")

    def shape(self, name: str) -> Mesh | PointCloud:
        """All triangles, or the points of a scene without any, in the frame of the scene."""
        mesh = self._gathered(name, SURFACES)
        if len(mesh.triangles) == 0:
            points = self._gathered(name, (POINTS,)).vertices
            if len(points):
                return cloud_of_filled(np.asarray(points), None, name)
        return mesh

    def _gathered(self, name: str, modes: tuple[int, ...]) -> Mesh:
        placed: list[tuple[Primitive, Float64[np.ndarray, "4 4"]]] = []
        count = faces = 0
        for index, at in self._placed_meshes():
            for described in get(self._item("meshes", index), "primitives", list):
                self._take(_STEPS_OF_A_PRIMITIVE)
                primitive = self._primitive(described, modes)
                if primitive is not None:
                    placed.append((primitive, at))
                    count += primitive.points
                    faces += primitive.triangles
                    check_surface(count, faces, self.size)
        vertices, triangles = np.empty((count, 3)), np.empty((faces, 3), np.int64)
        done = filled = 0
        for primitive, at in placed:
            first = done
            for points in primitive.blocks_of_points():
                with np.errstate(all="ignore"):  # what is not finite is refused later on
                    points = points @ at[:3, :3].T + at[:3, 3]
                vertices[done : done + len(points)] = points
                done += len(points)
            for corners in primitive.blocks_of_triangles():
                triangles[filled : filled + len(corners)] = corners + first
                filled += len(corners)
        return Mesh(vertices, triangles, name)

    def _take(self, steps: int) -> None:
        """Counts what takes time; raises CloudFileError where that is too much for the file."""
        self.steps += steps
        if self.steps > _STEPS + self.size / _BYTES_OF_A_STEP:
            raise CloudFileError(
                f"{self.size} bytes hold too many nodes, or place too many meshes again, wanted "
                "larger meshes or fewer of them"
            )

    def _placed_meshes(self) -> list[tuple[int, Float64[np.ndarray, "4 4"]]]:
        """Each mesh of the scene with the transform of its frame into the scene's."""
        nodes = get(self.document, "nodes", list, [])
        scenes = get(self.document, "scenes", list, [])
        if scenes:
            scene = self._item("scenes", get(self.document, "scene", int, 0))
            roots = get(scene, "nodes", list, [])
        else:
            children = (c for node in nodes for c in get(node, "children", list, []))
            below = {child for child in children if type(child) is int}
            roots = [index for index in range(len(nodes)) if index not in below]
        placed = []
        visited: set[int] = set()
        todo = [(root, np.eye(4)) for root in reversed(roots)]
        while todo:
            index, above = todo.pop()
            node = self._item("nodes", index)
            self._take(1)
            if index in visited:  # nodes are trees: without this a cycle would not end
                raise CloudFileError(f"node {index} hangs below two nodes, wanted a tree")
            visited.add(index)
            placed_at = above
            if is_moved(node):
                with np.errstate(all="ignore"):
                    placed_at = above @ placement(node)
            if "mesh" in node:
                placed.append((get(node, "mesh", int), placed_at))
            todo += [(child, placed_at) for child in reversed(get(node, "children", list, []))]
        return placed

    def _primitive(self, described: Any, modes: tuple[int, ...]) -> Primitive | None:
        mode = get(described, "mode", int, TRIANGLES)
        if mode not in modes:
            return None
        attributes = get(described, "attributes", dict)
        positions, scale = self._accessor(get(attributes, "POSITION", int), "VEC3")
        corners = None
        if "indices" in described:
            corners = self._accessor(get(described, "indices", int), "SCALAR")[0][:, 0]
            if corners.dtype.kind == "f":
                raise CloudFileError("the indices of a primitive are floats, wanted integers")
        return Primitive(positions, scale, corners, mode)

    def _accessor(self, index: int, kind: str) -> tuple[np.ndarray, float | None]:
        """The rows an accessor stands for, (n, 1) or (n, 3), in floats or integers, and what
        normalized integers are divided by."""
        accessor = self._item("accessors", index)
        code = get(accessor, "componentType", int)
        if get(accessor, "type", str) != kind or code not in _COMPONENTS or "sparse" in accessor:
            raise CloudFileError(f"accessor {index}: wanted {kind} of plain numbers")
        dtype, width = np.dtype(_COMPONENTS[code]), _WIDTHS[kind]
        view = self._item("bufferViews", get(accessor, "bufferView", int))
        data = self._buffer(get(view, "buffer", int))
        begin, size = get(view, "byteOffset", int, 0), get(view, "byteLength", int)
        skipped, count = get(accessor, "byteOffset", int, 0), get(accessor, "count", int)
        stride = get(view, "byteStride", int, dtype.itemsize * width)
        last = skipped + stride * (count - 1) + dtype.itemsize * width
        if (
            min(begin, skipped) < 0
            or count < 1
            or stride < dtype.itemsize * width
            or last > size
            or begin + size > len(data)
        ):
            raise CloudFileError(
                f"accessor {index}: {count} rows, {stride} bytes apart, end {last} bytes into a "
                f"view of {size} at byte {begin} of a buffer of {len(data)}"
            )
        strides = (stride, dtype.itemsize)
        rows = np.ndarray((count, width), dtype, data, begin + skipped, strides)
        if kind == "VEC3" and get(accessor, "normalized", bool, False) and dtype.kind != "f":
            return rows, float(np.iinfo(dtype).max)
        return rows, None

    def _buffer(self, index: int) -> bytes | memoryview:
        if index not in self.buffers:
            uri = get(self._item("buffers", index), "uri", str)
            if uri.startswith("data:"):
                comma = uri.find(",") + 1
                try:
                    # whatever is no letter of base64, as all of a text without a comma, is refused
                    self.buffers[index] = base64.b64decode(uri[comma:], validate=True)
                except ValueError as error:
                    raise CloudFileError(f"buffer {index}: {uri[:60]}: {error}") from None
                del self.document["buffers"][index]["uri"]  # it is long, and not needed again
            else:
                self.buffers[index] = self._beside(index, unquote(uri))
                self.size += len(self.buffers[index])
        return self.buffers[index]

    def _beside(self, index: int, uri: str) -> bytes:
        """A buffer in a file of its own; a document may not name files of other folders."""
        if "\0" in uri or Path(uri).name != uri or not os.path.isfile(self.folder / uri):
            raise CloudFileError(f"buffer {index}: wanted a file {uri[:80]!r} in the same folder")
        try:
            return contents(self.folder / uri)
        except CloudFileError as error:
            raise CloudFileError(f"buffer {index}: {uri[:80]!r} {error}") from None

    def _item(self, key: str, index: Any) -> dict:
        items = get(self.document, key, list)
        if type(index) is not int or not 0 <= index < len(items):
            raise CloudFileError(f"{key}: wanted one of {len(items)}, got {str(index)[:40]}")
        if not isinstance(items[index], dict):
            raise CloudFileError(f"{key}: number {index} is no JSON object")
        return items[index]
