"""What a file or folder of data holds, told by how it is laid out.

    pair-list   a CSV file, a line a pair               (`data.pairs`)
    pair-file   an HDF5 file, a group a pair            (`data.pairs`)
    corpus      HDF5 files of shapes, or a folder of them  (`data.corpus`)
    modelnet40  a folder of the benchmark: HDF5 files and lists of them  (`data.modelnet`)
    kitti       a folder of scans: sequences/NN/velodyne   (`data.kitti`)
    clouds      a folder of point clouds
    meshes      a folder of meshes

Only names and the first bytes of a few files are looked at, so that it takes no time.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import h5py

from cfr_jax.data.making.mesh_formats import mesh_formats
from cfr_jax.io import formats

Kind = Literal["pair-list", "pair-file", "corpus", "modelnet40", "kitti", "clouds", "meshes"]
KINDS = get_args(Kind)
CLOUD_SUFFIXES = tuple(formats.by_suffix(form for form in formats.of_clouds() if form.loose))
MESH_SUFFIXES = tuple(formats.by_suffix(mesh_formats()))
HDF5_SUFFIXES = (".h5", ".hdf5")
# Of these suffixes a file may be one or the other; its header tells.
_EITHER = (".ply",)
_HEADER = 4096  # bytes
_PEEKED = 16  # files of a folder whose headers are read


@dataclass(frozen=True)
class Layout:
    """What was recognized, and where."""

    kind: Kind
    path: Path
    found: str
    """In words, for whoever wonders what was made of their data."""

    def __str__(self) -> str:
        return f"{self.path}: {self.found}"


def recognize(path: str | Path, kind: str | None = None) -> Layout:
    """The layout of a file or folder; `kind` overrules what it looks like, and is only checked.

    Raises ValueError, with what is there and what was wanted, where nothing is recognized, where
    nothing is there, and where the data are not of the `kind` given.
    """
    path = Path(path)
    if kind is not None and kind not in KINDS:
        raise ValueError(f"layout: got {kind!r}, wanted one of {', '.join(KINDS)}")
    if not path.exists():
        raise ValueError(f"there is no file or folder {path}")
    chosen = (kind,) if kind is not None else KINDS
    for name in chosen:
        if (found := _TESTS[name](path)) is not None:
            if kind is None and name == "clouds" and _mostly_meshes(path):
                continue  # a readme.txt beside them is no cloud
            return Layout(name, path, found)
    if kind is not None:
        raise ValueError(f"{path} is not laid out as {kind}: it holds {_contents(path)}")
    raise ValueError(
        f"{path} is no data that is recognized: it holds {_contents(path)}\n"
        "wanted a CSV list or an HDF5 file of pairs, or a folder of clouds or meshes,"
        " of KITTI odometry, or of ModelNet40"
    )


def loose_files(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Files of a folder and its folders, in the order a person counts: scan2 before scan10."""
    found = [
        path
        for path in folder.rglob("*")
        if path.suffix.lower() in suffixes
        and path.is_file()
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    ]
    return sorted(found, key=lambda path: natural(path.relative_to(folder).as_posix()))


def natural(name: str) -> list[tuple[int, str]]:
    """A key that sorts numbers within names by their value."""
    return [
        (int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)
    ]


def scans_of(folder: Path) -> dict[str, list[Path]]:
    """The scans of each sequence in the layout of KITTI odometry."""
    places = sorted((folder / "sequences").glob("*/velodyne"))
    return {place.parent.name: sorted(place.glob("*.bin")) for place in places}


def _pair_list(path: Path) -> str | None:
    if not path.is_file() or path.suffix.lower() not in (".csv", ".tsv", ".txt"):
        return None
    try:
        lines = path.read_text("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError):
        return None
    rows = [line for line in lines if line.strip() and not line.startswith("#")]
    return f"a list of {len(rows)} lines, a pair each"


def _pair_file(path: Path) -> str | None:
    names, groups = _members(path)
    if groups and not {"data", "label"} & set(names):
        return f"{len(groups)} pairs in one HDF5 file"
    return None


def _corpus(path: Path) -> str | None:
    if path.is_dir():
        files = [file for file in path.iterdir() if file.suffix in HDF5_SUFFIXES]
        if files and (path / "shape_names.txt").is_file() and not _modelnet40(path):
            return f"a corpus of shapes in {len(files)} HDF5 files"
        return None
    return "a corpus of shapes in one HDF5 file" if "data" in _members(path)[0] else None


def _modelnet40(path: Path) -> str | None:
    lists = ("train_files.txt", "test_files.txt")
    if not path.is_dir() or not all((path / name).is_file() for name in lists):
        return None
    train, test = (len((path / name).read_text().split()) for name in lists)
    return f"ModelNet40 in HDF5, {train} files of training shapes and {test} of test shapes"


def _kitti(path: Path) -> str | None:
    scans = {name: files for name, files in scans_of(path).items() if files}
    if not scans:
        return None
    told = ", ".join(f"{name} ({len(files)} scans)" for name, files in scans.items())
    return f"LiDAR sequences in the layout of KITTI odometry: {told}"


def _clouds(path: Path) -> str | None:
    return _in_words("point clouds", _loose(path, CLOUD_SUFFIXES, surfaces=False))


def _meshes(path: Path) -> str | None:
    return _in_words("meshes", _loose(path, MESH_SUFFIXES, surfaces=True))


def _mostly_meshes(path: Path) -> bool:
    clouds = _loose(path, CLOUD_SUFFIXES, surfaces=False)
    return _loose(path, MESH_SUFFIXES, surfaces=True).total() > clouds.total()


def _in_words(name: str, kinds: Counter[str]) -> str | None:
    return f"{kinds.total()} {name} ({', '.join(sorted(kinds))})" if kinds else None


def _loose(path: Path, suffixes: tuple[str, ...], surfaces: bool) -> Counter[str]:
    """How many files of each suffix, those that may be either being what their headers say."""
    if not path.is_dir():
        return Counter()
    files = loose_files(path, suffixes)
    either = [file for file in files if file.suffix.lower() in _EITHER]
    # A folder's PLY files are taken to be alike: a few of them tell.
    fits = any(_has_faces(file) == surfaces for file in either[:_PEEKED])
    return Counter(file.suffix.lower() for file in files if fits or file not in either)


def _has_faces(path: Path) -> bool:
    try:
        with open(path, "rb") as stream:
            header = stream.read(_HEADER).partition(b"end_header")[0]
    except OSError:
        return False
    match = re.search(rb"element\s+(?:face|tristrips)\s+(\d+)", header)
    return match is not None and int(match[1]) > 0


def _members(path: Path) -> tuple[list[str], list[str]]:
    """Names of what an HDF5 file holds, and which of them are groups; none of another file."""
    if not path.is_file() or not h5py.is_hdf5(path):
        return [], []
    try:
        with h5py.File(path, "r") as file:
            return list(file), [name for name, value in file.items() if hasattr(value, "keys")]
    except OSError:
        return [], []


def _contents(path: Path) -> str:
    if path.is_file():
        size = path.stat().st_size
        return f"{size} bytes under the suffix {path.suffix!r}" if size else "nothing (0 bytes)"
    kinds = Counter(file.suffix.lower() or "no suffix" for file in path.iterdir())
    told = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common(5))
    return told or "nothing"


_TESTS: dict[Kind, Callable[[Path], str | None]] = {
    "pair-list": _pair_list,
    "pair-file": _pair_file,
    "corpus": _corpus,
    "modelnet40": _modelnet40,
    "kitti": _kitti,
    "clouds": _clouds,
    "meshes": _meshes,
}
