"""Training pairs from scans: pairs with a known motion, frames of a drive, or single scans.

Every pair is brought to the network as `align` does it: each cloud about its own centroid, both in
the unit sphere, thinned evenly. Scans without normals have them estimated.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from cfr_jax import io
from cfr_jax.data import kitti
from cfr_jax.data.augment import Sampling, View, choose_rows, finish_pair
from cfr_jax.data.layout import CLOUD_SUFFIXES, loose_files, scans_of
from cfr_jax.data.pairs import CsvPairs, Hdf5Pairs, Pair, among, open_pairs
from cfr_jax.data.protocol import crop
from cfr_jax.geometry import units

_HELD = 128  # pairs in memory: reading one takes longer than drawing from it
_MOST = 1 << 16  # points of a cloud in memory, drawn at random: scans of any size then fit
_FEWEST = 16  # points that differ: of fewer, crops and neighborhoods are no surfaces
Frames = tuple[int, int] | None
"""Only pairs whose frames both are at least the first and below the second; None: all."""


@dataclass(frozen=True, eq=False)
class SceneSource:
    """Scans in pairs; `frames[i]` names what item `i` was recorded from.

    `single`: both clouds of an item are one scan, of which views are to be drawn. `stamp` changes
    with the names and sizes of the files.
    """

    names: tuple[str, ...]
    frames: tuple[tuple[Hashable, ...], ...]
    read: Callable[[int], Pair]
    stamp: str
    single: bool = False

    def __len__(self) -> int:
        return len(self.names)

    def draw(self, index: int, sampling: Sampling, rng: np.random.Generator) -> dict:
        """A crop and a draw of points of each cloud, in the unit sphere."""
        pair = self.read(index)
        try:
            return self._draw(pair, sampling, rng)
        except ValueError as error:
            raise ValueError(f"{self.names[index]}: {error}") from error

    def _draw(self, pair: Pair, sampling: Sampling, rng: np.random.Generator) -> dict:
        uneven = rng.random() < sampling.uneven
        clouds = []
        for points, normals in (
            (pair.source, pair.source_normals),
            (pair.target, pair.target_normals),
        ):
            kept = crop(points, rng.uniform(*sampling.keep), rng)
            clouds.append(io.PointCloud(points[kept], None if normals is None else normals[kept]))
        frames = units.unit_frames(*clouds, None)
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
    where = str(Path(path).resolve())
    files = [Path(path)]
    recorded: list[tuple[Hashable, ...]]
    numbers: list[tuple[int | str, int | str]]
    if isinstance(held, Hdf5Pairs):
        numbers = [held.frames(i) for i in range(len(held))]
        recorded = [tuple((where, frame) for frame in pair) for pair in numbers]
    else:
        assert isinstance(held, CsvPairs)  # there is no third form
        numbers = list(held.listed)
        places = [[(held.path.parent / name).resolve() for name in pair] for pair in held.listed]
        recorded = [tuple((str(place),) for place in pair) for pair in places]
        files += sorted({place for pair in places for place in pair})
    rows: Sequence[int] = range(len(held))
    if frames is not None:
        if any(not isinstance(number, int) for pair in numbers for number in pair):
            raise ValueError(
                f"frames: {path} does not say from which frames its pairs are; "
                "make a list of pairs for training and another for validation"
            )
        rows = [i for i in rows if among(frames, numbers[i])]

    def read(row: int) -> Pair:
        pair = held[rows[row]]
        if pair.transform is None:
            raise ValueError(f"{path}: {pair.name} has no true transform to learn from")
        return pair

    return _source(path, [held.names[i] for i in rows], [recorded[i] for i in rows], read, files)


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
    return _source(
        path,
        [f"{sequence}/{a:06d}-{b:06d}" for sequence, a, b, _ in items],
        [((where, sequence, a), (where, sequence, b)) for sequence, a, b, _ in items],
        read,
        [file for sequence in sequences for file in scans_of(Path(path))[sequence]],
    )


def scans_source(path: str | Path) -> SceneSource:
    """Both clouds are views of one scan: every file below a folder whose suffix `cfr_jax.io` reads,
    but for hidden ones."""
    folder = Path(path)
    if not folder.is_dir():
        raise ValueError(f"no folder of scans at {folder}")
    files = loose_files(folder, CLOUD_SUFFIXES)

    def read(row: int) -> Pair:
        scan = io.read(files[row])
        clouds = scan.points, scan.points, scan.normals, scan.normals
        return Pair(files[row].name, *clouds, transform=np.eye(4))

    names = [file.relative_to(folder).as_posix() for file in files]
    recorded = [((str(file.resolve()),),) for file in files]
    return _source(path, names, recorded, read, files, single=True)


def _source(path, names, frames, read, files, single=False):
    if not names:
        wanted = " ".join(CLOUD_SUFFIXES) if single else "pairs, and some within `frames`"
        raise ValueError(f"{path}: no scan to train on there; wanted {wanted}")
    sizes = [file.stat().st_size if file.is_file() else -1 for file in files]
    stamp = hashlib.sha256(repr((list(names), sizes)).encode()).hexdigest()

    @functools.lru_cache(_HELD)
    def held(row: int) -> Pair:
        pair = read(row)
        where = f"{path}: {names[row]}"
        source = target = _held(
            where if single else f"{where}: source", pair.source, pair.source_normals
        )
        if not single:
            target = _held(f"{where}: target", pair.target, pair.target_normals)
        return Pair(pair.name, source[0], target[0], source[1], target[1], pair.transform)

    return SceneSource(tuple(names), tuple(frames), held, stamp, single)


def _held(where, points, normals):
    """What is kept in memory of a scan; raises ValueError for one that teaches nothing."""
    few = points[:: max(1, len(points) // 256)]  # enough to see whether all lie in one place
    if len(np.unique(few, axis=0)) < _FEWEST:
        raise ValueError(
            f"{where} has {len(points)} points, wanted at least {_FEWEST} in different places"
        )
    if len(points) > _MOST:
        rows = np.random.default_rng(0).choice(len(points), _MOST, replace=False)
        points, normals = points[rows], None if normals is None else normals[rows]
    return points, normals


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
        rows = units.subsample(points, sampling.points, int(rng.integers(2**32)))
    rows = rows[choose_rows(points[rows], sampling, uneven, rng)]
    normals = None if cloud.normals is None else cloud.normals[rows].astype(np.float32)
    return View(points[rows].astype(np.float32), normals)
