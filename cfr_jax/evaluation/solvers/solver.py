"""The interface of all methods: a solver of pairs, and the clouds that it is given."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from cfr_jax.data.pairs import Pair
from cfr_jax.io import PointCloud
from cfr_jax.io.cloud import usable_normals


@dataclass(frozen=True)
class Answer:
    """The answer of a method to one pair."""

    transforms: Float[np.ndarray, "i 4 4"]
    """One per iteration that the method reports; the last one is the answer. They map source onto
    target."""
    seconds: float
    """Time from clouds in host memory to motions in host memory, without compilation."""


Solver = Callable[[Sequence[Pair]], list[Answer]]


def clouds_of(pair: Pair, estimated: bool) -> tuple[PointCloud, PointCloud]:
    """Source and target, without normals if these are unusable or should be `estimated`."""
    return (
        _cloud("source", pair.source, None if estimated else pair.source_normals),
        _cloud("target", pair.target, None if estimated else pair.target_normals),
    )


def _cloud(name: str, points: np.ndarray, normals: np.ndarray | None) -> PointCloud:
    return PointCloud(points, None if normals is None else usable_normals(normals), name)
