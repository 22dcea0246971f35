"""What a confidence is fitted to: pairs whose answer is known, easy ones and hopeless ones.

A probability can only be learned from right and wrong answers. So of ten pairs made of a corpus of
shapes three are of the partial protocol with exact normals and two with estimated ones, three of
these five turned either way about each axis instead of one; two keep only half of each shape (one
with estimated normals); one is turned by any rotation and searched globally; one is turned by up to
90 degrees about each axis and is not searched; and one is of two different shapes.

Of pairs of your own both clouds stay whole in six of ten, and a half of each is cut off in the
others, by planes of any direction. Five are turned about their center: two either way by up to 45
degrees about each axis, two by up to 90, one by any rotation, which is searched globally.
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
from cfr_jax.data.protocol import (
    crop,
    low_overlap,
    partial,
    partial_any_rotation,
    partial_both_ways,
    random_motion,
    random_pair,
)

_TURNED = dataclasses.replace(partial, name="turned", angle=90.0)
# protocol, whether normals are estimated
_SHAPES = (
    (partial, False), *[(partial_both_ways, False)] * 2, (partial, True),
    (partial_both_ways, True), (low_overlap, False), (low_overlap, True),
    (partial_any_rotation, False), (_TURNED, False), (partial, True),
)  # fmt: skip
_SEARCHED, _DIFFERENT = 7, 9  # places in the mix
# by how many degrees, at most, about each axis (None: any rotation, searched globally), and whether
# half of each cloud is cut off
_PAIRS = (
    (0.0, False), (45.0, False), (0.0, True), (90.0, False), (0.0, False),
    (None, False), (45.0, True), (0.0, True), (90.0, True), (0.0, False),
)  # fmt: skip


@dataclasses.dataclass(frozen=True, eq=False)
class Trial:
    """Two clouds to align, and what a right answer is."""

    source: Float[np.ndarray, "n c"]
    """Points (n, 3), or points and normals (n, 6)."""
    target: Float[np.ndarray, "m c"]
    truth: Float[np.ndarray, "4 4"] | None
    """From source onto target; None where the clouds are of two things, and no answer is right."""
    searched: bool
    """Whether all rotations are to be tried."""
    group: int
    """The shape or the pair it was made of: a fit is tested on groups it has not seen."""
    radius: float | None = None
    """What translations are measured by; None: the scale at which `align` worked."""
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where translations are compared; far from the clouds, a small turn is a long way."""


@dataclasses.dataclass(frozen=True)
class OfShapes:
    """Trials made of a corpus, whose shapes fill the unit sphere."""

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
    """Trials made of pairs whose motions are known."""

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
"""As many trials as are asked for; each depends on its number alone."""


def open_trials(path: str | Path, seed: int) -> Trials:
    """Trials of a corpus of shapes, or of a list or an HDF5 file of pairs with known motions.

    Raises ValueError for other data.
    """
    layout = recognize(path)
    kind = layout.kind
    if kind.read_shapes is not None:
        return OfShapes(kind.read_shapes(Path(path)), seed)
    # pairs that need no settings: their files say which clouds and which truth
    if kind.evaluate is not None and not settings_of(kind.evaluate)[0]:
        return OfPairs(kind.evaluate(path, Path()), seed)
    raise ValueError(
        f"data: {layout}; wanted a list or an HDF5 file of pairs with their transforms, or a "
        "corpus of shapes (`cfr data build` makes one of meshes)"
    )


def _joined(points: np.ndarray, normals: np.ndarray | None) -> Float[np.ndarray, "n c"]:
    return points if normals is None else np.hstack([points, normals])
