"""Training pairs from scans: pairs with a known motion, frames of a drive, or single scans.

Every pair is brought to the network as `align` does it: each cloud about its own centroid, both in
the unit sphere, thinned evenly. Scans without normals have them estimated.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from cfr_jax import io, preparation
from cfr_jax.data import kitti
from cfr_jax.data.augment import Sampling, View, choose_rows, finish_pair
from cfr_jax.data.pairs import Hdf5Pairs, Pair, among, open_pairs
from cfr_jax.data.protocol import crop

_HELD = 256  # pairs in memory: reading one takes longer than drawing from it
Frames = tuple[int, int] | None
"""Only pairs whose frames both are at least the first and below the second; None: all."""


@dataclass(frozen=True, eq=False)
class SceneSource:
    """Scans in pairs; `frames[i]` names what item `i` was recorded from."""

    names: tuple[str, ...]
    frames: tuple[tuple[Hashable, ...], ...]
    read: Callable[[int], Pair]

    def __len__(self) -> int:
        return len(self.names)

    def draw(self, index: int, sampling: Sampling, rng: np.random.Generator) -> dict:
        """A crop and a draw of points of each cloud, in the unit sphere."""
        pair = self.read(index)
        uneven = rng.random() < sampling.uneven
        clouds = []
        for points, normals in (
            (pair.source, pair.source_normals),
            (pair.target, pair.target_normals),
        ):
            kept = crop(points, rng.uniform(*sampling.keep), rng)
            clouds.append(io.PointCloud(points[kept], None if normals is None else normals[kept]))
        frames = preparation.unit_frames(*clouds, None)
        centers = frames.source_center, frames.target_center
        views = [
            _view(cloud, center, frames.scale, sampling, uneven, rng)
            for cloud, center in zip(clouds, centers, strict=True)
        ]
        truth = np.array(pair.transform, np.float64)
        truth[:3, 3] += truth[:3, :3] @ frames.source_center - frames.target_center
        truth[:3, 3] /= frames.scale
        return finish_pair(*views, truth, sampling, rng)


def pairs_source(path: str | Path, frames: Frames = None) -> SceneSource:
    """The pairs of an HDF5 file or a CSV list (`data.pairs`), all of which need their truth.

    `frames` goes by the attributes `source_frame` and `target_frame` of the groups of HDF5.
    """
    held = open_pairs(path)
    tokens: tuple[tuple[Any, ...], ...]
    if isinstance(held, Hdf5Pairs):
        tokens = tuple(held.frames(i) for i in range(len(held)))
    else:
        tokens = tuple(tuple(name.split(" -> ")) for name in held.names)
    rows = range(len(held))
    if frames is not None:
        if any(not isinstance(token, int) for pair in tokens for token in pair):
            raise ValueError(
                f"frames: {path} does not say from which frames its pairs are; "
                "make a list of pairs for training and another for validation"
            )
        rows = [i for i in rows if among(frames, tokens[i])]

    def read(row: int) -> Pair:
        pair = held[rows[row]]
        if pair.transform is None:
            raise ValueError(f"{path}: {pair.name} has no true transform to learn from")
        return pair

    where = str(Path(path).resolve())
    return _checked(
        path,
        tuple(held.names[i] for i in rows),
        tuple(tuple((where, token) for token in tokens[i]) for i in rows),
        read,
    )


def kitti_source(
    path: str | Path,
    *,
    cache: Path,
    sequences: tuple[str, ...] = ("00",),
    distances: tuple[float, ...] = (10.0,),
    stride: int = 1,
    frames: Frames = None,
) -> SceneSource:
    """Frames of drives in KITTI's layout, `distances` meters apart, with refined truths.

    A pair starts every `stride` frames. Refined truths are kept in the folder `cache`.
    """
    items = []
    for sequence in sequences:
        for distance in distances:
            found = kitti.read_pairs(
                path, sequence, cache / f"truths_{sequence}_{distance:g}m.npz", distance, stride
            )
            for (a, b), transform in zip(found.frames.tolist(), found.transforms, strict=True):
                if among(frames, (a, b)):
                    items.append((sequence, a, b, transform))

    def read(row: int) -> Pair:
        sequence, a, b, transform = items[row]
        clouds = [kitti.read_frame(path, sequence, frame) for frame in (a, b)]
        return Pair(f"{sequence}/{a:06d}-{b:06d}", *clouds, transform=transform)

    where = str(Path(path).resolve())
    return _checked(
        path,
        tuple(f"{sequence}/{a:06d}-{b:06d}" for sequence, a, b, _ in items),
        tuple(((where, sequence, a), (where, sequence, b)) for sequence, a, b, _ in items),
        read,
    )


def scans_source(path: str | Path) -> SceneSource:
    """Both clouds are views of one scan: every file of a folder that `cfr_jax.io` reads."""
    folder = Path(path)
    if not folder.is_dir():
        raise ValueError(f"no folder of scans at {folder}")
    files = sorted(p for p in folder.rglob("*") if p.is_file() and not p.name.startswith("."))

    def read(row: int) -> Pair:
        scan = io.read(files[row])
        clouds = scan.points, scan.points, scan.normals, scan.normals
        return Pair(files[row].name, *clouds, transform=np.eye(4))

    names = tuple(file.relative_to(folder).as_posix() for file in files)
    return _checked(path, names, tuple(((str(file.resolve()),),) for file in files), read)


def _checked(path, names, frames, read):
    if not names:
        raise ValueError(f"{path}: no pair of scans there, or none within `frames`")
    return SceneSource(names, frames, functools.lru_cache(_HELD)(read))


def _view(
    cloud: io.PointCloud,
    center: Float[np.ndarray, " 3"],
    scale: float,
    sampling: Sampling,
    uneven: bool,
    rng: np.random.Generator,
) -> View:
    points = (cloud.points - center) / scale
    rows = np.arange(len(points))
    if not uneven:
        rows = preparation.subsample(points, sampling.points, int(rng.integers(2**32)))
    rows = rows[choose_rows(points[rows], sampling, uneven, rng)]
    normals = None if cloud.normals is None else cloud.normals[rows].astype(np.float32)
    return View(points[rows].astype(np.float32), normals)
