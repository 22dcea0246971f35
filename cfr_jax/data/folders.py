"""What lies in a folder or an HDF5 file, by names and first bytes alone: nothing is read."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from cfr_jax.io.formats import Format, by_suffix

HDF5_SUFFIXES = (".h5", ".hdf5")
_START = 4096  # bytes that tell whether a file has faces
_PEEKED = 16  # files of a folder whose first bytes are read


def loose_files(folder: Path, formats: Iterable[Format]) -> list[Path]:
    """Files of a folder and its folders, in the order a person counts: scan2 before scan10.

    Hidden ones, and formats whose files have to be named, are passed over.
    """
    suffixes = {suffix for suffix, form in by_suffix(formats).items() if form.loose}
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


def count_loose(folder: Path, formats: Iterable[Format], surfaces: bool) -> Counter[str]:
    """How many files of each suffix hold surfaces, or else clouds.

    Those of a format that may be either are what their first bytes say.
    """
    if not folder.is_dir():
        return Counter()
    known = by_suffix(formats)
    counts: Counter[str] = Counter()
    open_questions: dict[Format, list[Path]] = {}
    for path in loose_files(folder, known.values()):
        form = known[path.suffix.lower()]
        if form.has_faces is None:
            counts[path.suffix.lower()] += 1
        else:
            open_questions.setdefault(form, []).append(path)
    for form, paths in open_questions.items():
        # A folder's files of one format are taken to be alike: a few of them tell.
        if any(_has_faces(form, path) == surfaces for path in paths[:_PEEKED]):
            counts.update(path.suffix.lower() for path in paths)
    return counts


def in_words(name: str, counts: Counter[str]) -> str | None:
    """As "3 meshes (.off, .stl)"; None of nothing."""
    return f"{counts.total()} {name} ({', '.join(sorted(counts))})" if counts else None


def hdf5_members(path: Path) -> tuple[list[str], list[str]]:
    """Names of what an HDF5 file holds, and which of them are groups; none of another file."""
    import h5py

    if not path.is_file() or not h5py.is_hdf5(path):
        return [], []
    try:
        with h5py.File(path, "r") as file:
            return list(file), [name for name, value in file.items() if hasattr(value, "keys")]
    except OSError:
        return [], []


def _has_faces(form: Format, path: Path) -> bool:
    assert form.has_faces is not None  # that is what makes it an open question
    try:
        with open(path, "rb") as stream:
            return form.has_faces(stream.read(_START))
    except OSError:
        return False
