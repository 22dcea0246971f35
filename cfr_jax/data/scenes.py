"""Training pairs from scans: pairs with a known motion, or single scans.

Each pair is prepared as in `align`: each cloud is centered at its own centroid, both are scaled
into the unit sphere, and both are thinned evenly. Missing normals are estimated.
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
from cfr_jax.data.augmentation.pairs_on_host import View, choose_rows, finish_pair
from cfr_jax.data.augmentation.sampling import Sampling
from cfr_jax.data.pairs import Pair
from cfr_jax.data.perturbations import crop
from cfr_jax.geometry import thinning, units
from cfr_jax.io import formats
from cfr_jax.io.formats import by_suffix

_HELD = 128  # pairs kept in memory, because reading one takes longer than drawing from it
_MOST = 1 << 16  # points kept of a cloud, drawn at random, so that scans of any size fit in memory
_FEWEST = 16  # distinct points; with fewer, crops and neighborhoods do not form surfaces


@dataclass(frozen=True, eq=False)
class SceneSource:
    """Pairs of scans. `frames[i]` names the recordings that item `i` comes from.

    If `single`, both clouds of an item are the same scan, and training draws two views of it.
    `stamp` changes with the names and sizes of the files.
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
        """What the items are called, in the plural."""
        return "single scans" if self.single else "pairs of scans"

    @property
    def recorded(self) -> frozenset[Hashable]:
        """All recordings that items come from."""
        return frozenset(frame for item in self.frames for frame in item)

    @property
    def check(self) -> Callable[[int], object]:
        """`read`, which finds bad items in advance. Otherwise they are read only when drawn."""
        return self.read

    def draw(self, index: int, sampling: Sampling, rng: np.random.Generator) -> dict[str, Any]:
        """A pair in the unit sphere, from a crop and a draw of points of each cloud."""
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
        """A recorded pair, thinned to `sampling.points` and rotated by up to 45 degrees about each
        axis.

        For a single scan, two views are drawn with `sampling`, as in training, because the whole
        scan would be registered with itself.
        """
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
    """A source of the pairs that `read` returns; the most recent ones are kept in memory.

    Each pair needs its true motion. `names` and `frames` are those of `SceneSource`, with one entry
    per item. `read` must be picklable, for workers that are processes. `files` are all files that
    are read, for the stamp. Raises ValueError if there are no items.
    """
    if not names:
        clouds = " ".join(by_suffix(form for form in formats.of_clouds() if form.loose))
        wanted = f"files ending in {clouds}" if single else "pairs, and some within `frames`"
        raise ValueError(f"{path}: found no scans to train on, wanted {wanted}")
    sizes = [file.stat().st_size if file.is_file() else -1 for file in files]
    stamp = hashlib.sha256(repr((list(names), sizes)).encode()).hexdigest()

    return SceneSource(
        tuple(names), tuple(frames), _Recent(path, tuple(names), read, single), stamp, single
    )


class _Recent:
    """Reads items, and keeps the most recent ones. Its copy in another process starts empty."""

    def __init__(
        self, path: str | Path, names: tuple[str, ...], read: Callable[[int], Pair], single: bool
    ):
        self._given = path, names, read, single
        self.recent = functools.lru_cache(_HELD)(functools.partial(_read, *self._given))

    def __call__(self, row: int) -> Pair:
        return self.recent(row)

    def __reduce__(self) -> tuple[Any, ...]:
        return _Recent, self._given


def _read(
    path: str | Path, names: tuple[str, ...], read: Callable[[int], Pair], single: bool, row: int
) -> Pair:
    pair = read(row)
    where = f"{path}: {names[row]}"
    source = target = _held(
        where if single else f"{where}: source", pair.source, pair.source_normals
    )
    if not single:
        target = _held(f"{where}: target", pair.target, pair.target_normals)
    return Pair(pair.name, source[0], target[0], source[1], target[1], pair.transform)


def _held(
    where: object, points: np.ndarray, normals: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """The part of a scan that is kept in memory. Raises ValueError if it has too few places."""
    few = points[:: max(1, len(points) // 256)]  # enough to see whether all points coincide
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
        rows = thinning.subsample(points, sampling.points, int(rng.integers(2**32)))
    rows = rows[choose_rows(points[rows], sampling, uneven, rng)]
    normals = None if cloud.normals is None else cloud.normals[rows].astype(np.float32)
    return View(points[rows].astype(np.float32), normals)
