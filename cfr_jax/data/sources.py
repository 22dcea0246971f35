"""Sources of training pairs: the interface of all sources, and the source of shapes.

The source of scans is in `data.scenes`. `data.mixture` mixes several sources.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from cfr_jax.data import perturbations, protocol
from cfr_jax.data.augmentation.pairs_on_host import View, choose_rows, finish_pair
from cfr_jax.data.augmentation.sampling import Sampling, shared_count
from cfr_jax.data.corpus import Corpus
from cfr_jax.data.loader import Source
from cfr_jax.geometry.neighbors import nearest_on_host


@runtime_checkable
class TrainingSource(Source, Protocol):
    """A source that can describe its data and provide validation pairs."""

    @property
    def noun(self) -> str:
        """What its items are called, in the plural."""
        ...

    @property
    def stamp(self) -> str:
        """A string that changes if the data changes, but not if it is moved."""
        ...

    @property
    def recorded(self) -> frozenset[Hashable]:
        """Names of the recordings that it uses.

        A recording must not be used for both training and validation.
        """
        ...

    @property
    def check(self) -> Callable[[int], object] | None:
        """A function that reads item i and raises ValueError if it cannot be used.

        None if the source read all of its items when it was opened.
        """
        ...

    def fixed_pair(
        self,
        index: int,
        sampling: Sampling,
        neighbors: int,
        radius: float,
        rng: np.random.Generator,
    ) -> dict[str, Any]:
        """A validation pair from item `index`, in the format of `pairs_on_host.finish_pair`."""
        ...


@dataclass(frozen=True)
class ShapeSource:
    """Both clouds are views of one shape of a corpus."""

    corpus: Corpus

    noun = "shapes"
    recorded: frozenset[Hashable] = frozenset()
    check = None

    def __len__(self) -> int:
        return len(self.corpus)

    @property
    def stamp(self) -> str:
        """A digest of all names and of some of the points."""
        digest = hashlib.sha256("\n".join(self.corpus.names).encode())
        digest.update(self.corpus.points[:, ::64].tobytes())
        return digest.hexdigest()

    def draw(self, index: int, sampling: Sampling, rng: np.random.Generator) -> dict[str, Any]:
        """A pair from one shape. Each cloud has its own crop, and its own draw of points unless
        they are copied."""
        points, normals = self.corpus[index]
        if sampling.copied:
            rows = perturbations.resample(len(points), shared_count(sampling, len(points)), rng)
            points, normals = points[rows], normals[rows]
        uneven = rng.random() < sampling.uneven
        views = []
        for _ in range(2):
            keep = rng.uniform(*sampling.keep)
            kept = perturbations.crop(points, keep, rng) if keep < 1 else np.arange(len(points))
            rows = kept[choose_rows(points[kept], sampling, uneven, rng)]
            views.append(View(points[rows], normals[rows]))
        return finish_pair(views[0], views[1], np.eye(4), sampling, rng)

    def fixed_pair(
        self,
        index: int,
        sampling: Sampling,
        neighbors: int,
        radius: float,
        rng: np.random.Generator,
    ) -> dict[str, Any]:
        """A pair by the published partial protocol, with 717 points. It ignores `sampling` and
        `rng`."""
        pair = protocol.fixed_pair(self.corpus, index, protocol.partial)
        made = {"transform": pair.transform, "estimate_normals": False}
        for side in ("source", "target"):
            cloud = made[side] = getattr(pair, side)
            made[f"{side}_normals"] = getattr(pair, f"{side}_normals")
            made[f"{side}_neighbors"] = nearest_on_host(cloud, neighbors, radius=radius)
        return made
