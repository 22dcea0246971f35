"""The table of formats: everyone who reads, writes, recognizes or lists files asks here.

Each format is a record below; what parses it is in a file of its own in this folder: bytes in,
points out. `add_format` adds one from outside. The table imports neither numpy nor any parser, so
that help texts can show it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, BinaryIO, Literal

if TYPE_CHECKING:
    from cfr_jax.io.cloud import PointCloud
    from cfr_jax.io.mesh import Mesh


@dataclass(frozen=True)
class Format:
    """How files of one format are told and read, and perhaps written."""

    name: str
    suffixes: tuple[str, ...]
    """Lower case, with the dot; they tell the format, and no two formats share one."""
    holds: Literal["cloud", "surface", "either"]
    parse: Callable[..., PointCloud | Mesh]
    """`parse(data, name)`: from all bytes of a file, and its name, to what it holds.

    Raises ValueError with the place in the file and what was wanted. It must not believe a header
    that promises more than the file's size allows.
    """
    save: Callable[[BinaryIO, PointCloud], None] | None = None
    """`save(stream, cloud)`; None: files of this format are only read."""
    needs_folder: bool = False
    """Files that name other files: `parse` gets the folder as a third argument."""
    has_faces: Callable[[bytes], bool] | None = None
    """For `holds="either"`: whether the first bytes of a file announce a surface."""
    loose: bool = True
    """Whether a file found in a folder is taken for a scan; if not, it has to be named."""
    note: str = ""
    """A few words that help texts put in parentheses behind the suffixes."""

    def __post_init__(self) -> None:
        if not self.suffixes or any(
            suffix[:1] != "." or suffix != suffix.lower() for suffix in self.suffixes
        ):
            raise ValueError(f"suffixes: got {self.suffixes}, wanted lower case, as in ('.ply',)")
        if (self.holds == "either") != (self.has_faces is not None):
            raise ValueError(
                f"has_faces: {self.name} holds {self.holds!r}; wanted a function for 'either' alone"
            )


def later(home: str, name: str) -> Callable[..., Any]:
    """The function `name` of the module `home`, which is imported at the first call."""

    def call(*args: Any) -> Any:
        return getattr(import_module(home), name)(*args)

    return call


def _here(file: str, name: str) -> Callable[..., Any]:
    return later(f"{__name__}.{file}", name)


_FORMATS: list[Format] = [
    Format(
        "PLY",
        (".ply",),
        "either",
        _here("ply", "parse"),
        _here("ply", "save"),
        has_faces=_here("ply", "has_faces"),
    ),
    Format("PCD", (".pcd",), "cloud", _here("pcd", "parse"), _here("pcd", "save")),
    Format("text", (".xyz", ".txt"), "cloud", _here("text", "parse"), _here("text", "save")),
    # a table found in a folder may be a list of pairs, or anything
    Format("CSV", (".csv",), "cloud", _here("text", "parse"), loose=False),
    Format("NPY", (".npy",), "cloud", _here("arrays", "parse_npy"), _here("arrays", "save_npy")),
    Format("NPZ", (".npz",), "cloud", _here("arrays", "parse_npz"), _here("arrays", "save_npz")),
    Format("Velodyne", (".bin",), "cloud", _here("arrays", "parse_velodyne"), note="KITTI"),
    Format("LAS", (".las",), "cloud", _here("las", "parse")),
    Format("LAZ", (".laz",), "cloud", _here("las", "parse"), note='pip install "cfr_jax[io]"'),
    Format("OFF", (".off",), "surface", _here("surfaces", "parse_off")),
    Format("OBJ", (".obj",), "surface", _here("surfaces", "parse_obj")),
    Format("STL", (".stl",), "surface", _here("surfaces", "parse_stl")),
    Format("GLB", (".glb",), "surface", _here("gltf", "parse_glb"), needs_folder=True),
    Format("glTF", (".gltf",), "surface", _here("gltf", "parse_gltf"), needs_folder=True),
]


def known() -> tuple[Format, ...]:
    """All formats, in the order in which they are listed."""
    return tuple(_FORMATS)


def of_clouds() -> tuple[Format, ...]:
    """Those whose files hold, or may hold, points without faces."""
    return tuple(form for form in _FORMATS if form.holds != "surface")


def of_surfaces() -> tuple[Format, ...]:
    """Those whose files hold, or may hold, faces."""
    return tuple(form for form in _FORMATS if form.holds != "cloud")


def writable() -> tuple[Format, ...]:
    """Those that `cfr_jax.io.write` writes."""
    return tuple(form for form in _FORMATS if form.save is not None)


def add_format(new: Format) -> None:
    """Adds a format to the table: `read`, `write`, every command and every folder then know it.

    Raises ValueError where another format has one of its suffixes.
    """
    taken = by_suffix(_FORMATS)
    for suffix in new.suffixes:
        if suffix in taken:
            raise ValueError(f"suffixes: {suffix} is taken by {taken[suffix].name}, wanted another")
    _FORMATS.append(new)


def by_suffix(chosen: Iterable[Format]) -> dict[str, Format]:
    """Formats by suffix; the keys, in order, are what a message lists."""
    return {suffix: form for form in chosen for suffix in form.suffixes}


def in_words(chosen: Iterable[Format]) -> str:
    """The suffixes of formats, with their notes, for a help text."""
    words = (" ".join(form.suffixes) + (f" ({form.note})" if form.note else "") for form in chosen)
    return " ".join(words)
