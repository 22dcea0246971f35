"""HDF5 files of pairs: one group per pair.

A group has `source` (N, 3), `target` (M, 3), and optionally `source_normals`, `target_normals`,
`transform` (4, 4), and a number `overlap`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from cfr_jax.data.hdf5 import reading as hdf5
from cfr_jax.data.pairs.pair import Pair, PairFile
from cfr_jax.geometry.motions import check_rigid
from cfr_jax.runtime.messages import Refused, shown

_OF_A_PAIR = ("source", "target", "source_normals", "target_normals", "transform", "overlap")


class Hdf5Pairs(PairFile):
    """Groups of an HDF5 file, in the order of their names."""

    def __init__(self, path: str | Path):
        super().__init__(path)
        self._names = tuple(sorted(hdf5.read(self.path, groups=True).groups))
        if not self._names:
            raise Refused(f"{shown(path)} has no groups; wanted one per pair: source, target, ...")

    def __len__(self) -> int:
        return len(self._names)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the groups."""
        return self._names

    def frames(self, index: int) -> tuple[str | int, str | int]:
        """Frames that the source and the target of a pair were recorded from.

        These are the group's attributes `source_frame` and `target_frame`, or names that are unique
        to the pair if it lacks them.
        """
        name = self.names[index]
        frames = [("", "source_frame"), ("", "target_frame")]
        said = hdf5.read(self.path, group=name, attributes=frames).attributes
        if len(said) == 2:
            return int(said["@source_frame"]), int(said["@target_frame"])
        return f"{name}/source", f"{name}/target"

    def _make(self, index: int) -> Pair:
        name = self.names[index]
        where = f"{shown(self.path)}, {shown(name)}"
        found = hdf5.read(self.path, group=name, arrays=_OF_A_PAIR)
        held = found.arrays
        missing = [key for key in ("source", "target") if key not in held]
        if missing:
            raise Refused(f"{where} lacks {missing}, and holds only {sorted(found.names)}")
        for key in ("source", "target", "source_normals", "target_normals"):
            if key in held:
                held[key] = _checked_rows(
                    held[key], like=held[key.split("_")[0]], where=where, key=key
                )
        truth, overlap = held.get("transform"), held.get("overlap")
        if overlap is not None and (overlap.size != 1 or not np.isfinite(overlap).all()):
            raise Refused(f"{where}: overlap has the shape {overlap.shape}, wanted one number")
        return Pair(
            name=name,
            source=held["source"],
            target=held["target"],
            source_normals=held.get("source_normals"),
            target_normals=held.get("target_normals"),
            transform=None if truth is None else check_rigid(f"{where}: transform", truth),
            overlap=None if overlap is None else float(overlap.reshape(())),
        )


def _checked_rows(
    values: np.ndarray, like: np.ndarray, where: str, key: str
) -> Float[np.ndarray, "n 3"]:
    wanted = (len(like), 3) if like.ndim else (0, 3)
    if values.shape != wanted or not len(values) or values.dtype.kind not in "fiu":
        raise ValueError(f"{where}: {key} is {values.dtype} {values.shape}, wanted numbers (N, 3)")
    if not np.isfinite(values).all():
        raise ValueError(f"{where}: {key} holds numbers that are not finite")
    return (
        values if values.dtype.itemsize > 2 and values.dtype.kind == "f" else values.astype(float)
    )
