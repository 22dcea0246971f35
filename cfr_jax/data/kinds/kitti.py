"""LiDAR sequences in the layout of KITTI odometry (`data.kitti`)."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from cfr_jax.data.kinds.kind import DataKind

if TYPE_CHECKING:
    import numpy as np

    from cfr_jax.data.pairs import Pair
    from cfr_jax.data.scenes import SceneSource

    _Item: TypeAlias = tuple[str, int, int, np.ndarray]  # sequence, two frames, motion


def recognize(path: Path) -> str | None:
    """Looks for folders `sequences/NN/velodyne` with scans."""
    scans = {name: files for name, files in _sequences(path).items() if files}
    if not scans:
        return None
    told = ", ".join(f"{name} ({len(files)} scans)" for name, files in scans.items())
    return f"LiDAR sequences in the layout of KITTI odometry: {told}"


def train(
    path: str | Path,
    cache: Path,
    *,
    sequences: tuple[str, ...] = ("00",),
    distances: tuple[float, ...] = (10.0,),
    stride: int = 1,
    frames: tuple[int, int] | None = None,
) -> SceneSource:
    """Pairs of frames that are `distances` meters apart, with refined true motions.

    The refined motions are kept in `cache`. A pair starts every `stride` frames. Both of its frames
    lie in the half-open range `frames` (None: all).
    """
    from cfr_jax.data import kitti
    from cfr_jax.data.pairs import among
    from cfr_jax.data.scenes import scene_source

    items: list[_Item] = []
    for sequence in sequences:
        for distance in distances:
            found = kitti.read_pairs(
                path, sequence, cache / f"truths_{sequence}_{distance:g}m.npz", distance, stride
            )
            for (a, b), transform in zip(found.frames.tolist(), found.transforms, strict=True):
                if among(frames, (a, b)):
                    items.append((sequence, a, b, transform))

    where = str(Path(path).resolve())
    return scene_source(
        path,
        names=[f"{sequence}/{a:06d}-{b:06d}" for sequence, a, b, _ in items],
        frames=[((where, sequence, a), (where, sequence, b)) for sequence, a, b, _ in items],
        read=functools.partial(_read, path, items),
        files=[file for sequence in sequences for file in _sequences(Path(path))[sequence]],
    )


def _read(path: str | Path, items: list[_Item], row: int) -> Pair:
    from cfr_jax.data import kitti
    from cfr_jax.data.pairs import Pair

    sequence, a, b, transform = items[row]
    source, target = (kitti.read_frame(path, sequence, frame) for frame in (a, b))
    return Pair(f"{sequence}/{a:06d}-{b:06d}", source, target, transform=transform)


def evaluate(
    path: str | Path,
    cache: Path,
    *,
    sequences: tuple[str, ...],
    distance: float,
    stride: int,
    points: int,
    angle: float,
    translation: float,
    frames: tuple[int, int] | tuple[()] | None = None,
) -> Sequence[Pair]:
    """Pairs of frames that are `distance` meters apart, thinned to `points` and moved at random.

    See `kitti.scan_pair`. With a `stride` of 0, the next pair starts after the end of the last one,
    as published.
    """
    from cfr_jax.data import kitti
    from cfr_jax.data.pairs import among
    from cfr_jax.runtime.sequences import OnDemand

    parts = [
        kitti.read_pairs(
            path,
            sequence,
            cache=cache / f"truths_{sequence}.npz",
            distance=distance,
            stride=stride or None,
        )
        for sequence in sequences
    ]
    places = [
        (part, index)
        for part in parts
        for index, pair in enumerate(part.frames.tolist())
        if among(frames or None, pair)
    ]

    def make(index: int) -> Pair:
        part, row = places[index]
        return kitti.scan_pair(part, row, points, angle, translation)

    return OnDemand(len(places), make)


def list_scans(path: Path) -> list[Path]:
    """The scans of all sequences, one sequence after another."""
    return [file for files in _sequences(path).values() for file in files]


def _sequences(folder: Path) -> dict[str, list[Path]]:
    """The scans of each sequence."""
    places = sorted((folder / "sequences").glob("*/velodyne"))
    return {place.parent.name: sorted(place.glob("*.bin")) for place in places}


KIND = DataKind(
    name="kitti",
    words="a folder of KITTI odometry",
    recognize=recognize,
    train=train,
    evaluate=evaluate,
    example="eval_scans_lidar.py",
    list_scans=list_scans,
)
