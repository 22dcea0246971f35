"""A folder of meshes, from which `cfr data build` makes a corpus."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from cfr_jax.data.folders import count_loose, in_words, loose_files
from cfr_jax.data.kinds.kind import DataKind
from cfr_jax.data.making.mesh_formats import mesh_formats
from cfr_jax.io import formats


def count(path: Path) -> Counter[str]:
    """How many meshes of each suffix are in a folder and its subfolders."""
    return count_loose(path, mesh_formats(), surfaces=True)


def recognize(path: Path) -> str | None:
    """Looks at the suffixes of all files in the folder, and at the headers of those that may have
    no faces."""
    return in_words("meshes", count(path))


def list_scans(path: Path) -> list[Path]:
    """The meshes in formats that `cfr_jax.io` also reads."""
    return loose_files(path, formats.of_surfaces())


KIND = DataKind(
    name="meshes",
    words="a folder of meshes",
    recognize=recognize,
    list_scans=list_scans,
)
