"""What training pairs come from: the interface of all sources, and the one of shapes.

The one of scans is in `data.scenes`; several are mixed by `data.mixture`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from cfr_jax.data import protocol
from cfr_jax.data.augment import Sampling, View, choose_rows, finish_pair
from cfr_jax.data.corpus import Corpus
from cfr_jax.data.loader import Source
from cfr_jax.geometry.neighbors import nearest_on_host


@runtime_checkable
class TrainingSource(Source, Protocol):
    """A source that can tell what it holds, and be validated on."""

    @property
    def noun(self) -> str:
        """What its items are called, in the plural."""
        ...

    @property
    def stamp(self) -> str:
        """Changes when the data do, and not with the place where they lie."""
        ...

    @property
    def recorded(self) -> frozenset[Hashable]:
        """Names of the recordings that it uses, which no other source may be validated on."""
        ...

    @property
    def check(self) -> Callable[[int], object] | None:
        """Reads item i, and raises ValueError where it cannot be used; None if the source read all
        of its items when it was opened."""
        ...

    def fixed_pair(
        self,
        index: int,
        sampling: Sampling,
        neighbors: int,
        radius: float,
        rng: np.random.Generator,
    ) -> dict[str, Any]:
        """A pair of item `index` to validate on, as `augment.finish_pair` gives it."""
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
        """Of all names, and of some of the points."""
        digest = hashlib.sha256("\n".join(self.corpus.names).encode())
        digest.update(self.corpus.points[:, ::64].tobytes())
        return digest.hexdigest()

    def draw(self, index: int, sampling: Sampling, rng: np.random.Generator) -> dict[str, Any]:
        """Each cloud is a crop and a draw of points of its own."""
        points, normals = self.corpus[index]
        uneven = rng.random() < sampling.uneven
        views = []
        for _ in range(2):
            kept = protocol.crop(points, rng.uniform(*sampling.keep), rng)
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
        """By the published partial protocol, 717 points; nothing else decides about it."""
        pair = protocol.fixed_pair(self.corpus, index, protocol.partial)
        made = {"transform": pair.transform, "estimate_normals": False}
        for side in ("source", "target"):
            cloud = made[side] = getattr(pair, side)
            made[f"{side}_normals"] = getattr(pair, f"{side}_normals")
            made[f"{side}_neighbors"] = nearest_on_host(cloud, neighbors, radius=radius)
        return made
