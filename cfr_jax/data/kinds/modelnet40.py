"""The folder of the ModelNet40 benchmark (`data.modelnet`)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from cfr_jax.data.kinds import corpus
from cfr_jax.data.kinds.kind import DataKind
from cfr_jax.runtime.messages import Refused
from cfr_jax.runtime.reading import text

if TYPE_CHECKING:
    from cfr_jax.data.pairs import Pair


def recognize(path: Path) -> str | None:
    """Looks for the two lists of HDF5 files."""
    lists = ("train_files.txt", "test_files.txt")
    if not path.is_dir() or not all((path / name).is_file() for name in lists):
        return None
    try:
        train, test = (len(text(path / name, 1 << 20).split()) for name in lists)
    except Refused:
        return None
    return f"ModelNet40 in HDF5, {train} files of training shapes and {test} of test shapes"


def evaluate(
    path: str | Path, cache: Path, *, split: Literal["train", "val", "test"], protocol: str
) -> Sequence[Pair]:
    """One pair per shape of a published split."""
    from cfr_jax.data.modelnet import read_modelnet40
    from cfr_jax.data.protocol import fixed_pairs

    return fixed_pairs(read_modelnet40(path, split), protocol)


KIND = DataKind(
    name="modelnet40",
    words="the folder of ModelNet40",
    recognize=recognize,
    evaluate=evaluate,
    example="eval_modelnet40.py",
    read_shapes=corpus.read_shapes,
)
