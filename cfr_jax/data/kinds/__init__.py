"""The table of kinds of data, with one file per kind. All code that opens data looks here.

`add` adds a kind from outside. Neither the table nor its files import readers before data is
read, so that help texts can show the table quickly.
"""

from __future__ import annotations

from collections.abc import Iterable

from cfr_jax.data.kinds import clouds, corpus, kitti, meshes, modelnet40, pair_file, pair_list
from cfr_jax.data.kinds.kind import DataKind

# In the order in which recognition tries them.
_KINDS: list[DataKind] = [
    pair_list.KIND,
    pair_file.KIND,
    modelnet40.KIND,  # before `corpus`, because it is a corpus, too
    corpus.KIND,
    kitti.KIND,
    clouds.KIND,
    meshes.KIND,
]
# Names in older configs, from before all code shared one vocabulary.
_RENAMED = {
    "shapes": "corpus",
    "pairs": "pair-list (a CSV list) or pair-file (HDF5)",
    "scans": "clouds",
}


def entries() -> tuple[DataKind, ...]:
    """All kinds of data, in the order in which recognition tries them."""
    return tuple(_KINDS)


def add(new: DataKind) -> None:
    """Adds a kind of data to the table for `cfr batch`, `train.py` and `evaluate.py`.

    Recognition tries it before all others, because a folder with a new layout may look like a
    folder of clouds. Raises ValueError if the name is taken.
    """
    if not isinstance(new, DataKind):
        raise ValueError(f"new: got {new!r}, wanted a DataKind")
    if new.name == "auto" or any(new.name == kind.name for kind in _KINDS):
        raise ValueError(f"name: {new.name!r} is taken, wanted another")
    _KINDS.insert(0, new)


def named(name: str, where: str, among: Iterable[DataKind]) -> DataKind:
    """The kind with this name. Raises ValueError, naming the field `where`, if it is not in
    `among`."""
    by_name = {kind.name: kind for kind in among}
    if name in by_name:
        return by_name[name]
    if name in _RENAMED:
        raise ValueError(f"{where}: {name!r} has a new name: {_RENAMED[name]}")
    raise ValueError(f"{where}: got {name!r}, wanted one of {', '.join(by_name)}")
