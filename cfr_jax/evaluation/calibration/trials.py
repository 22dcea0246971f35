"""Trials, to which a confidence is fitted: pairs whose answer is known, from easy to hopeless.

A probability can only be learned from right and wrong answers. So of every ten pairs from a corpus
of shapes:

- five follow the partial protocol, two of them with estimated normals; three of the five are
  rotated either way about each axis instead of one way;
- two keep only half of each shape, one of them with estimated normals;
- one is rotated by any rotation and searched globally;
- one is rotated by up to 90 degrees about each axis and not searched;
- one consists of two different shapes.

Of every ten pairs of your own, six keep both clouds whole. The other four lose half of each cloud,
cut off by planes of any direction. Five are rotated about their center: two by up to 45 degrees
either way about each axis, two by up to 90, and one by any rotation, which is searched globally.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from cfr_jax.data.corpus import Corpus
from cfr_jax.data.kinds.kind import settings_of
from cfr_jax.data.layout import recognize
from cfr_jax.data.pairs import Pair
from cfr_jax.data.perturbations import crop, random_motion
from cfr_jax.data.protocol import (
    low_overlap,
    partial,
    partial_any_rotation,
    partial_both_ways,
    random_pair,
)

_TURNED = dataclasses.replace(partial, name="turned", angle=90.0)
# protocol, whether normals are estimated
_SHAPES = (
    (partial, False), *[(partial_both_ways, False)] * 2, (partial, True),
    (partial_both_ways, True), (low_overlap, False), (low_overlap, True),
    (partial_any_rotation, False), (_TURNED, False), (partial, True),
)  # fmt: skip
_SEARCHED, _DIFFERENT = 7, 9  # positions in `_SHAPES`
# largest rotation about each axis in degrees (None: any rotation, searched globally), and whether
# half of each cloud is cut off
_PAIRS = (
    (0.0, False), (45.0, False), (0.0, True), (90.0, False), (0.0, False),
    (None, False), (45.0, True), (0.0, True), (90.0, True), (0.0, False),
)  # fmt: skip


@dataclasses.dataclass(frozen=True, eq=False)
class Trial:
    """Two clouds to align, and what makes an answer right."""

    source: Float[np.ndarray, "n c"]
    """Points (n, 3), or points and normals (n, 6)."""
    target: Float[np.ndarray, "m c"]
    truth: Float[np.ndarray, "4 4"] | None
    """From source onto target; None if the clouds show different things, so no answer is right."""
    searched: bool
    """Whether to search all rotations."""
    group: int
    """The shape or pair that it was made from; a fit is tested on groups it has not seen."""
    radius: float | None = None
    """The unit in which translation errors are judged; None: the scale at which `align` worked."""
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The point at which translations are compared. Far from the clouds, a small rotation would
    look like a large translation."""


@dataclasses.dataclass(frozen=True)
class OfShapes:
    """Trials made from a corpus, whose shapes fill the unit sphere."""

    corpus: Corpus
    seed: int

    def trial(self, number: int) -> Trial:
        """Trial `number`, from 0."""
        rng = np.random.default_rng((self.seed, number))
        place = number % len(_SHAPES)
        protocol, estimated = _SHAPES[place]
        shape, other = (int(rng.integers(len(self.corpus))) for _ in range(2))
        pair = target = random_pair(*self.corpus[shape], protocol, rng)
        if place == _DIFFERENT:
            target = random_pair(*self.corpus[other], protocol, rng)
        return Trial(
            _joined(pair.source, None if estimated else pair.source_normals),
            _joined(target.target, None if estimated else target.target_normals),
            truth=np.asarray(pair.transform, np.float64) if target is pair else None,
            searched=place == _SEARCHED,
            group=shape,
            radius=1.0,
        )


@dataclasses.dataclass(frozen=True)
class OfPairs:
    """Trials made from pairs with known motions."""

    pairs: Sequence[Pair]
    seed: int

    def trial(self, number: int) -> Trial:
        """Trial `number`, from 0."""
        rng = np.random.default_rng((self.seed, number))
        row, (angle, halved) = int(rng.integers(len(self.pairs))), _PAIRS[number % len(_PAIRS)]
        pair = self.pairs[row]
        if pair.transform is None:
            raise ValueError(f"data: pair {pair.name} has no true transform; wanted one for each")
        center = pair.source.mean(axis=0, dtype=np.float64)
        motion = np.eye(4)
        if angle != 0:
            motion = random_motion(angle, 0.0, rng, both_ways=True).astype(np.float64)
        turn = motion[:3, :3]
        motion[:3, 3] = center - turn @ center  # about the cloud's own center
        normals = None if pair.source_normals is None else pair.source_normals @ turn.T
        source = _joined((pair.source - center) @ turn.T + center, normals)
        target = _joined(pair.target, pair.target_normals)
        if halved:
            source, target = (cloud[crop(cloud[:, :3], 0.5, rng)] for cloud in (source, target))
        return Trial(
            source,
            target,
            truth=pair.transform @ np.linalg.inv(motion),
            searched=angle is None,
            group=row,
            center=tuple(center.tolist()),
        )


Trials = OfShapes | OfPairs
"""Any number of trials; each depends only on its number and the seed."""


def open_trials(path: str | Path, seed: int) -> Trials:
    """Trials from a corpus of shapes, or from a list or an HDF5 file of pairs with known motions.

    Raises ValueError for other data.
    """
    layout = recognize(path)
    kind = layout.kind
    if kind.read_shapes is not None:
        return OfShapes(kind.read_shapes(Path(path)), seed)
    # only pairs that need no settings: their files name the clouds and the truth
    if kind.evaluate is not None and not settings_of(kind.evaluate)[0]:
        return OfPairs(kind.evaluate(path, Path()), seed)
    raise ValueError(
        f"data: {layout}; wanted a list or an HDF5 file of pairs with their transforms, or a "
        "corpus of shapes (`cfr data build` makes one from meshes)"
    )


def _joined(points: np.ndarray, normals: np.ndarray | None) -> Float[np.ndarray, "n c"]:
    return points if normals is None else np.hstack([points, normals])
