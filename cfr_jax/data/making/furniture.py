"""SH3F, the furniture libraries of Sweet Home 3D: a zip file of OBJ models with a catalog.

The catalog, `PluginFurnitureCatalog.properties`, has lines `key#INDEX=value`. The lines with one
INDEX describe one piece. A model is an OBJ file in the zip, or a nested zip that contains one.
"""

from __future__ import annotations

import io
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cfr_jax.io.formats.meshes.surfaces import parse_obj
from cfr_jax.io.mesh import Mesh

CATALOG = "PluginFurnitureCatalog.properties"
LARGEST_MODEL = 1 << 28  # bytes; a zip can unpack to any size

_LINE = re.compile(r"(\w+)#(\d+)\s*[=:]\s*(.*)")
_ESCAPE = re.compile(r"\\(u[0-9a-fA-F]{4}|.)")


@dataclass(frozen=True)
class Piece:
    """One entry of a catalog. The identifier is unique within its library."""

    identifier: str
    name: str
    category: str
    creator: str
    model: str  # path in the zip
    size: tuple[float, float, float]  # width, height, depth (x, y, z) in meters

    def scaled(self, mesh: Mesh) -> Mesh:
        """The mesh in meters at its true size, y up, with its bounding box centered at the
        origin."""
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        scale = np.array(self.size) / np.where(high > low, high - low, 1.0)
        return Mesh((mesh.vertices - (low + high) / 2) * scale, mesh.triangles, mesh.name)


class FurnitureLibrary:
    """An open SH3F file, to be used in a `with` statement.

    Raises ValueError if the file is not a furniture library.
    """

    def __init__(self, path: Path):
        self.path = path
        try:
            self._zip = zipfile.ZipFile(path)
            text = content_of(self._zip, CATALOG).decode("latin1")
        except (OSError, zipfile.BadZipFile, KeyError) as error:
            raise ValueError(f"{path} is not a furniture library (SH3F): {error}") from error
        self.pieces: tuple[Piece, ...] = _pieces(text, path)

    def __enter__(self) -> FurnitureLibrary:
        return self

    def __exit__(self, *_: object) -> None:
        self._zip.close()

    def mesh(self, piece: Piece) -> Mesh:
        """The model of a piece, in the units of its file (see `Piece.scaled`)."""
        shape = parse_obj(_model(self._zip, piece.model), piece.identifier)
        if not isinstance(shape, Mesh):
            raise ValueError(f"{piece.identifier}: has no faces, wanted a mesh")
        return shape


def _pieces(text: str, path: Path) -> tuple[Piece, ...]:
    entries: dict[int, dict[str, str]] = {}
    for line in text.splitlines():
        if match := _LINE.match(line.strip()):
            key, index, value = match.groups()
            entries.setdefault(int(index), {})[key] = _ESCAPE.sub(_unescaped, value.strip())
    pieces = []
    for index, entry in sorted(entries.items()):
        missing = [key for key in ("name", "model", "width", "depth", "height") if key not in entry]
        if missing:
            raise ValueError(f"{path}: entry {index} of the catalog lacks {missing}")
        try:
            width, depth, height = (float(entry[key]) for key in ("width", "depth", "height"))
        except ValueError:
            raise ValueError(f"{path}: entry {index} has a size that is not a number") from None
        pieces.append(
            Piece(
                identifier=entry.get("id", f"{index}"),
                name=entry["name"],
                category=entry.get("category", ""),
                creator=entry.get("creator", ""),
                model=entry["model"].lstrip("/"),
                size=(width / 100, height / 100, depth / 100),
            )
        )
    return tuple(pieces)


def _unescaped(match: re.Match[str]) -> str:
    code = match[1]
    return chr(int(code[1:], 16)) if len(code) == 5 else code


def _model(archive: zipfile.ZipFile, name: str) -> bytes:
    try:
        data = content_of(archive, name)
        if not zipfile.is_zipfile(io.BytesIO(data)) or name.lower().endswith(".obj"):
            return data
        with zipfile.ZipFile(io.BytesIO(data)) as nested:
            models = [inner for inner in nested.namelist() if inner.lower().endswith(".obj")]
            if not models:
                raise ValueError(f"{name} holds no OBJ file")
            return content_of(nested, models[0])
    except (KeyError, zipfile.BadZipFile) as error:
        raise ValueError(f"cannot read {name}: {error}") from error


def content_of(archive: zipfile.ZipFile, name: str) -> bytes:
    """The bytes of a file in an archive. Raises ValueError if they are many more than a model
    has."""
    size = archive.getinfo(name).file_size
    if size > LARGEST_MODEL:
        raise ValueError(f"{name} unpacks to {size} bytes, wanted at most {LARGEST_MODEL}")
    return archive.read(name)
