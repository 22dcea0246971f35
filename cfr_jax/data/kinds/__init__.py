"""The table of kinds of data: one file each, and everyone who opens data looks here.

`add_kind` adds one from outside. Neither the table nor the files below it import what reads data
before it is read, so that help texts can show the table.
"""

from __future__ import annotations

from collections.abc import Iterable

from cfr_jax.data.kinds import clouds, corpus, kitti, meshes, modelnet40, pair_file, pair_list
from cfr_jax.data.kinds.kind import DataKind

# In the order in which they are tried.
_KINDS: list[DataKind] = [
    pair_list.KIND,
    pair_file.KIND,
    modelnet40.KIND,  # before `corpus`: it is one, too
    corpus.KIND,
    kitti.KIND,
    clouds.KIND,
    meshes.KIND,
]
# What configs called some of them before there was one vocabulary.
_RENAMED = {
    "shapes": "corpus",
    "pairs": "pair-list (a CSV list) or pair-file (HDF5)",
    "scans": "clouds",
}


def known() -> tuple[DataKind, ...]:
    """All kinds of data, in the order in which they are tried."""
    return tuple(_KINDS)


def add_kind(new: DataKind) -> None:
    """Adds a kind of data to the table: `cfr batch`, `train.py` and `evaluate.py` then know it.

    It is tried before all others, since a folder of its own layout may look like one of clouds.
    Raises ValueError where its name is taken.
    """
    if new.name == "auto" or any(new.name == kind.name for kind in _KINDS):
        raise ValueError(f"name: {new.name!r} is taken, wanted another")
    _KINDS.insert(0, new)


def named(name: str, where: str, among: Iterable[DataKind]) -> DataKind:
    """The kind of that name; raises ValueError, naming the field `where`, if it is not `among`."""
    by_name = {kind.name: kind for kind in among}
    if name in by_name:
        return by_name[name]
    if name in _RENAMED:
        raise ValueError(f"{where}: {name!r} has a new name: {_RENAMED[name]}")
    raise ValueError(f"{where}: got {name!r}, wanted one of {', '.join(by_name)}")
