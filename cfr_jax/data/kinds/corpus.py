"""HDF5 files of shapes, or a folder of them (`data.corpus`)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cfr_jax.data.folders import HDF5_SUFFIXES, hdf5_members
from cfr_jax.data.kinds.kind import DataKind

if TYPE_CHECKING:
    from cfr_jax.data.corpus import Corpus
    from cfr_jax.data.pairs import Pair
    from cfr_jax.data.sources import ShapeSource


def recognize(path: Path) -> str | None:
    """An HDF5 file with `data`, or a folder of HDF5 files with a `shape_names.txt`."""
    if path.is_dir():
        files = [file for file in path.iterdir() if file.suffix in HDF5_SUFFIXES]
        if files and (path / "shape_names.txt").is_file():
            return f"a corpus of shapes in {len(files)} HDF5 files"
        return None
    return "a corpus of shapes in one HDF5 file" if "data" in hdf5_members(path)[0] else None


def train(path: str | Path, cache: Path) -> ShapeSource:
    """Pairs of two views of one shape."""
    from cfr_jax.data.sources import ShapeSource

    return ShapeSource(read_shapes(path))


def evaluate(path: str | Path, cache: Path, *, protocol: str) -> Sequence[Pair]:
    """One pair per shape, by a protocol that is named in `data.protocol`."""
    from cfr_jax.data.protocol import fixed_pairs

    return fixed_pairs(read_shapes(path), protocol)


def read_shapes(path: str | Path) -> Corpus:
    """The whole corpus."""
    from cfr_jax.data.corpus import read_corpus

    return read_corpus(path)


KIND = DataKind(
    name="corpus",
    words="a corpus of shapes in HDF5",
    recognize=recognize,
    train=train,
    evaluate=evaluate,
    example="eval_open_cad.py",
    read_shapes=read_shapes,
)
