"""The table of formats: everyone who reads, writes, recognizes or lists files asks here.

Each format is a record below; what parses it is in a file of its own in this folder: bytes in,
points out. `add` adds one from outside. The table imports neither numpy nor any parser, so
that help texts can list it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, BinaryIO, Literal, get_args

if TYPE_CHECKING:
    from cfr_jax.io.cloud import PointCloud
    from cfr_jax.io.mesh import Mesh

_Holds = Literal["cloud", "surface", "either"]


@dataclass(frozen=True)
class Format:
    """How files of one format are told and read, and perhaps written."""

    name: str
    suffixes: tuple[str, ...]
    """Lower case, with the dot; they tell the format, and no two formats share one."""
    holds: _Holds
    parse: Callable[..., PointCloud | Mesh]
    """`parse(data, name)`: from all bytes of a file, and its name, to what it holds.

    Raises ValueError with the place in the file and what was wanted. It must not believe a header
    that promises more than the file's size allows.
    """
    save: Callable[[BinaryIO, PointCloud], Iterable[str] | None] | None = None
    """`save(stream, cloud)`; None: files of this format are only read. It may return sentences
    about what the format cannot hold."""
    needs_folder: bool = False
    """Files that name other files: `parse` gets the folder as a third argument."""
    has_faces: Callable[[bytes], bool] | None = None
    """For `holds="either"`: whether the first bytes of a file announce a surface."""
    loose: bool = True
    """Whether a file found in a folder is taken for a scan; if not, it has to be named."""
    has_columns: bool = False
    """Whether `parse` takes the keywords `columns` (names that the user gave, or None) and `whole`
    (whether the cloud is to carry its table, so that it can be written again)."""
    note: str = ""
    """A few words that help texts put in parentheses behind the suffixes."""

    def __post_init__(self) -> None:
        if self.holds not in get_args(_Holds):
            known = ", ".join(map(repr, get_args(_Holds)))
            raise ValueError(f"holds: got {self.holds!r}, wanted one of {known}")
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

    def call(*args: Any, **options: Any) -> Any:
        return getattr(import_module(home), name)(*args, **options)

    return call


def _here(file: str, name: str) -> Callable[..., Any]:
    return later(f"{__name__}.{file}", name)


def _cloud(
    name: str,
    suffixes: tuple[str, ...],
    parse: str,
    save: str | None = None,
    *,
    loose: bool = True,
    note: str = "",
) -> Format:
    """A format of clouds whose columns a user may name; functions as "file:function"."""
    return Format(
        name,
        suffixes,
        "cloud",
        _here(*parse.split(":")),
        None if save is None else _here(*save.split(":")),
        loose=loose,
        has_columns=True,
        note=note,
    )


_FORMATS: list[Format] = [
    Format(
        "PLY",
        (".ply",),
        "either",
        _here("ply.reading", "parse"),
        _here("ply.writing", "save"),
        has_faces=_here("ply.reading", "has_faces"),
        has_columns=True,
    ),
    _cloud("PCD", (".pcd",), "pcd.reading:parse", "pcd.writing:save"),
    _cloud("text", (".xyz", ".txt", ".asc"), "text.table:parse", "text.writing:save"),
    # a table found in a folder may be a list of pairs, or anything
    _cloud("CSV", (".csv",), "text.table:parse", "text.writing:save_csv", loose=False),
    _cloud("XYZN", (".xyzn",), "text.table:parse_xyzn"),
    _cloud("XYZRGB", (".xyzrgb",), "text.table:parse_xyzrgb"),
    _cloud("PTS", (".pts",), "text.leica:parse_pts"),
    _cloud("PTX", (".ptx",), "text.leica:parse_ptx"),
    _cloud("NPY", (".npy",), "arrays.npy:parse", "arrays.writing:save_npy"),
    _cloud("NPZ", (".npz",), "arrays.npz:parse", "arrays.writing:save_npz"),
    _cloud("Velodyne", (".bin",), "arrays.velodyne:parse", note="KITTI, nuScenes"),
    _cloud("LAS", (".las",), "las.reading:parse"),
    _cloud("LAZ", (".laz",), "las.reading:parse", note='pip install "cfr_jax[io]"'),
    _cloud("E57", (".e57",), "e57:parse", note='pip install "cfr_jax[e57]"'),
    Format("OFF", (".off",), "surface", _here("meshes.surfaces", "parse_off")),
    Format("OBJ", (".obj",), "surface", _here("meshes.surfaces", "parse_obj")),
    Format("STL", (".stl",), "surface", _here("meshes.stl", "parse")),
    Format("GLB", (".glb",), "surface", _here("meshes.gltf", "parse_glb"), needs_folder=True),
    Format("glTF", (".gltf",), "surface", _here("meshes.gltf", "parse_gltf"), needs_folder=True),
    Format("G3D", (".g3d",), "surface", _here("meshes.g3d", "parse"), note="Megaglest"),
    Format("PIE", (".pie",), "surface", _here("meshes.pie", "parse"), note="Warzone 2100"),
]


def entries() -> tuple[Format, ...]:
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


def add(new: Format) -> None:
    """Adds a format to the table: `read`, `write`, every command and every folder then know it.

    Raises ValueError where another format has one of its suffixes.
    """
    if not isinstance(new, Format):
        raise ValueError(f"new: got {new!r}, wanted a Format")
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
