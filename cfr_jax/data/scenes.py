"""Training pairs from scans: pairs with a known motion, or single scans.

Every pair is brought to the network as `align` does it: each cloud about its own centroid, both in
the unit sphere, thinned evenly. Scans without normals have them estimated.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from cfr_jax import io
from cfr_jax.data.augment import Sampling, View, choose_rows, finish_pair
from cfr_jax.data.pairs import Pair
from cfr_jax.data.protocol import crop
from cfr_jax.geometry import units
from cfr_jax.io import formats
from cfr_jax.io.formats import by_suffix

_HELD = 128  # pairs in memory: reading one takes longer than drawing from it
_MOST = 1 << 16  # points of a cloud in memory, drawn at random: scans of any size then fit
_FEWEST = 16  # points that differ: of fewer, crops and neighborhoods are no surfaces


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

    @property
    def noun(self) -> str:
        """What the items are called."""
        return "single scans" if self.single else "pairs of scans"

    @property
    def recorded(self) -> frozenset[Hashable]:
        """All that any item was recorded from."""
        return frozenset(frame for item in self.frames for frame in item)

    @property
    def check(self) -> Callable[[int], object]:
        """Items are read when they are drawn; `read` finds the bad ones before."""
        return self.read

    def draw(self, index: int, sampling: Sampling, rng: np.random.Generator) -> dict[str, Any]:
        """A crop and a draw of points of each cloud, in the unit sphere."""
        pair = self.read(index)
        try:
            return self._draw(pair, sampling, rng)
        except ValueError as error:
            raise ValueError(f"{self.names[index]}: {error}") from error

    def fixed_pair(
        self,
        index: int,
        sampling: Sampling,
        neighbors: int,
        radius: float,
        rng: np.random.Generator,
    ) -> dict[str, Any]:
        """A recorded pair as it is, thinned to `sampling.points` and turned by up to 45 degrees
        about each axis. Of a single scan two views are drawn by `sampling`, as in training: whole,
        it would be laid on itself."""
        fewer = min(neighbors, sampling.points - 1)
        if self.single:
            chosen = dataclasses.replace(sampling, neighbors=fewer, radius=radius)
        else:
            chosen = Sampling(
                points=sampling.points,
                neighbors=fewer,
                radius=radius,
                keep=(1.0, 1.0),
                translation=0.1,
                noise=(0.0, 0.0),
            )
        return self.draw(index, chosen, rng)

    def _draw(self, pair: Pair, sampling: Sampling, rng: np.random.Generator) -> dict[str, Any]:
        uneven = rng.random() < sampling.uneven
        clouds = []
        for points, normals in (
            (pair.source, pair.source_normals),
            (pair.target, pair.target_normals),
        ):
            kept = crop(points, rng.uniform(*sampling.keep), rng)
            clouds.append(io.PointCloud(points[kept], None if normals is None else normals[kept]))
        frames = units.unit_frames(clouds[0], clouds[1], None)
        centers = frames.source_center, frames.target_center
        views = [
            _view(cloud, center, frames.scale, sampling, uneven, rng)
            for cloud, center in zip(clouds, centers, strict=True)
        ]
        truth = np.array(pair.transform, np.float64)
        truth[:3, 3] += truth[:3, :3] @ frames.source_center - frames.target_center
        truth[:3, 3] /= frames.scale
        return finish_pair(views[0], views[1], truth, sampling, rng)


def scene_source(
    path: str | Path,
    *,
    names: Sequence[str],
    frames: Sequence[tuple[Hashable, ...]],
    read: Callable[[int], Pair],
    files: Sequence[Path],
    single: bool = False,
) -> SceneSource:
    """A source whose pairs `read` gives, with their truths; the last ones stay in memory.

    `names` and `frames` are those of `SceneSource`, one of each item; `files` are all that is read,
    for the stamp. Raises ValueError where there is no item.
    """
    if not names:
        clouds = " ".join(by_suffix(form for form in formats.of_clouds() if form.loose))
        wanted = clouds if single else "pairs, and some within `frames`"
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


def _held(
    where: object, points: np.ndarray, normals: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray | None]:
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
