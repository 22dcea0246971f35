"""What a folder or an HDF5 file contains, judged from names and first bytes only."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from cfr_jax.io.formats import Format, by_suffix
from cfr_jax.runtime.messages import Refused
from cfr_jax.runtime.reading import opened

HDF5_SUFFIXES = (".h5", ".hdf5")
_START = 4096  # bytes that are enough to see whether a file has faces
_PEEKED = 16  # files of a format in a folder whose first bytes are read


def loose_files(folder: Path, formats: Iterable[Format]) -> list[Path]:
    """Files in a folder and its subfolders, in natural order: scan2 before scan10.

    Hidden files are skipped, and so are formats that are read only if a file is named explicitly.
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
    """A sort key that orders numbers within names by value."""
    return [
        (int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)
    ]


def count_loose(folder: Path, formats: Iterable[Format], surfaces: bool) -> Counter[str]:
    """How many files of each suffix hold surfaces or, if not `surfaces`, clouds.

    If a format may hold either, the first bytes of the files decide.
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
        # A folder's files of one format are assumed to be alike, so a few of them are enough.
        if any(_has_faces(form, path) == surfaces for path in paths[:_PEEKED]):
            counts.update(path.suffix.lower() for path in paths)
    return counts


def in_words(name: str, counts: Counter[str]) -> str | None:
    """A phrase such as "3 meshes (.off, .stl)", or None if there are none."""
    return f"{counts.total()} {name} ({', '.join(sorted(counts))})" if counts else None


def hdf5_members(path: Path) -> tuple[list[str], list[str]]:
    """Names of all members of an HDF5 file, and of its groups; both empty for any other file."""
    from cfr_jax.data.hdf5 import reading

    if not reading.is_hdf5(path):
        return [], []
    try:
        held = reading.read(path, groups=True)
    except Refused:
        return [], []
    return held.names, held.groups


def _has_faces(form: Format, path: Path) -> bool:
    assert form.has_faces is not None  # only such formats are asked
    try:
        with opened(path) as stream:
            return form.has_faces(stream.read(_START))
    except (Refused, OSError):
        return False
