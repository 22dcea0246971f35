"""An HDF5 file with one group per pair (`data.pairs`)."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cfr_jax.data.folders import hdf5_members
from cfr_jax.data.kinds.kind import DataKind, Listing

if TYPE_CHECKING:
    from cfr_jax.data.pairs import Pair, PairFile
    from cfr_jax.data.scenes import SceneSource


def recognize(path: Path) -> str | None:
    """An HDF5 file with groups, but without the members of a corpus."""
    names, groups = hdf5_members(path)
    if groups and not {"data", "label"} & set(names):
        return f"{len(groups)} pairs in one HDF5 file"
    return None


def train(path: str | Path, cache: Path, *, frames: tuple[int, int] | None = None) -> SceneSource:
    """The pairs with `source_frame` and `target_frame` in the half-open range `frames`.

    None means all pairs. Each pair needs its true transform.
    """
    from cfr_jax.data.pairs import Hdf5Pairs, among
    from cfr_jax.data.scenes import scene_source

    held = Hdf5Pairs(path)
    numbers = [held.frames(row) for row in range(len(held))]
    if frames is not None and not all(isinstance(n, int) for pair in numbers for n in pair):
        raise ValueError(
            f"frames: {path} does not say from which frames its pairs come; "
            "make a separate file for each use"
        )
    rows = [row for row in range(len(held)) if among(frames, numbers[row])]
    where = str(held.path.resolve())
    return scene_source(
        path,
        names=[held.names[row] for row in rows],
        frames=[tuple((where, frame) for frame in numbers[row]) for row in rows],
        read=functools.partial(_read, held, rows),
        files=[held.path],
    )


def _read(held: PairFile, rows: list[int], index: int) -> Pair:
    from cfr_jax.data.pairs import with_truth

    return with_truth(held, rows[index])


def evaluate(
    path: str | Path, cache: Path, *, frames: tuple[int, int] | tuple[()] | None = None
) -> Sequence[Pair]:
    """The pairs in the range `frames`, as in training. Pairs without frame numbers are in no range;
    without `frames`, all pairs are used."""
    from cfr_jax.data.pairs import Hdf5Pairs, among
    from cfr_jax.runtime.sequences import OnDemand

    held = Hdf5Pairs(path)
    if not frames:
        return held
    rows = [row for row in range(len(held)) if among(frames, held.frames(row))]
    return OnDemand(len(rows), lambda index: held[rows[index]])


def list_pairs(path: Path) -> Listing:
    """The groups. Each is read only when its turn comes."""
    from cfr_jax.data.pairs import Hdf5Pairs

    held = Hdf5Pairs(path)
    names = [(f"{name}/source", f"{name}/target") for name in held.names]
    pairs = [_reader(held, row, names[row]) for row in range(len(held))]
    return Listing(names, pairs, "pairs of an HDF5 file")


def _reader(held: Sequence[Pair], row: int, names: tuple[str, str]) -> Callable[[], Any]:
    from cfr_jax.io import PointCloud
    from cfr_jax.io.cloud import usable_normals

    def cloud(points: Any, normals: Any, name: str) -> PointCloud:
        return PointCloud(points, None if normals is None else usable_normals(normals), name)

    def read() -> tuple[PointCloud, PointCloud]:
        pair = held[row]
        return (
            cloud(pair.source, pair.source_normals, names[0]),
            cloud(pair.target, pair.target_normals, names[1]),
        )

    return read


KIND = DataKind(
    name="pair-file",
    words="an HDF5 file of pairs",
    recognize=recognize,
    train=train,
    evaluate=evaluate,
    example="eval_scans_rgbd.py",
    list_pairs=list_pairs,
)
