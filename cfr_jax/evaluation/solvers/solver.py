"""What every method is in the end: a solver of pairs, and the clouds that it is given."""

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
    """What a method says of one pair."""

    transforms: Float[np.ndarray, "i 4 4"]
    """One for each iteration it tells of; the last is the answer. Maps source onto target."""
    seconds: float
    """From clouds in host memory to motions in host memory, without compilation."""


Solver = Callable[[Sequence[Pair]], list[Answer]]


def clouds_of(pair: Pair, estimated: bool) -> tuple[PointCloud, PointCloud]:
    """Source and target, without their normals where these are unusable or not wanted."""
    return (
        _cloud("source", pair.source, None if estimated else pair.source_normals),
        _cloud("target", pair.target, None if estimated else pair.target_normals),
    )


def _cloud(name: str, points: np.ndarray, normals: np.ndarray | None) -> PointCloud:
    return PointCloud(points, None if normals is None else usable_normals(normals), name)
