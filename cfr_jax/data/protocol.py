"""Pairs made from shapes: the published test procedures, also with random numbers for training.

All random numbers come from the generator that is passed in, in a fixed order. So `fixed_pair`
repeats, draw by draw, the test set on which RPM-Net (Yew & Lee, 2020) and its successors publish
their results.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float32, Int

from cfr_jax.data.corpus import Corpus
from cfr_jax.data.pairs import Pair
from cfr_jax.data.perturbations import Rng, crop, jitter, opposite_sides, random_motion, resample
from cfr_jax.geometry import motions
from cfr_jax.runtime.sequences import OnDemand


@dataclass(frozen=True)
class Protocol:
    """How a pair is made from a shape.

    Without crop and noise, the two clouds hold the same points, drawn once, and the pair's clean
    clouds are those points. Otherwise each cloud draws its own points.
    """

    name: str
    points: int = 1024  # of an uncropped cloud; a cropped one has ceil(keep * points)
    keep: float | None = None  # share of the shape that a crop keeps
    noise: bool = True  # N(0, 0.01), clipped at 0.05
    angle: float | None = 45.0  # degrees; each Euler angle from [0, angle]; None: any rotation
    both_ways: bool = False  # each angle from [-angle, angle] instead, as in users' clouds
    translation: float = 0.5  # each coordinate is drawn from [-translation, translation]
    # share of each cropped cloud that the other has, too: both are cut across one direction, from
    # opposite ends, where `keep` draws a direction for each
    overlap: float | None = None

    def __post_init__(self) -> None:
        if self.points < 1:
            raise ValueError(f"points: got {self.points}, wanted at least 1")
        if self.keep is not None and not 0 < self.keep < 1:
            raise ValueError(f"keep: got {self.keep}, wanted None or a share between 0 and 1")
        if self.overlap is not None and (self.keep is not None or not 0 < self.overlap < 1):
            raise ValueError(
                f"overlap: got {self.overlap} with keep {self.keep}, wanted None or a share "
                "between 0 and 1, and no keep"
            )


clean: Final = Protocol("clean", noise=False)
noise: Final = Protocol("noise")
partial: Final = Protocol("partial", keep=0.7)
low_overlap: Final = Protocol("low_overlap", keep=0.5)
partial_both_ways: Final = Protocol("partial_both_ways", keep=0.7, both_ways=True)
partial_any_rotation: Final = Protocol("partial_any_rotation", keep=0.7, angle=None)
by_overlap: Final = tuple(
    Protocol(f"overlap_{tenths}", overlap=tenths / 10, both_ways=True) for tenths in range(1, 10)
)
PROTOCOLS = {
    made.name: made
    for made in (
        *(clean, noise, partial, low_overlap, partial_both_ways, partial_any_rotation),
        *by_overlap,
    )
}


def fixed_pairs(corpus: Corpus, protocol: str) -> OnDemand[Pair]:
    """The published test set for `corpus` by the protocol of this name.

    Raises ValueError for an unknown protocol.
    """
    if protocol not in PROTOCOLS:
        raise ValueError(f"protocol: got {protocol!r}, wanted one of {', '.join(PROTOCOLS)}")
    chosen = PROTOCOLS[protocol]
    return OnDemand(len(corpus), lambda index: fixed_pair(corpus, index, chosen))


def fixed_pair(corpus: Corpus, index: int, protocol: Protocol) -> Pair:
    """Pair `index` of the published test set for `corpus` by `protocol`.

    The legacy generator is reseeded with the index before the crop, before the motion, and before
    the draw of points. `clean` takes the first points instead of drawing. Raises ValueError for an
    index out of range.
    """
    if not 0 <= index < len(corpus):
        raise ValueError(f"index: got {index}, wanted 0 to {len(corpus) - 1}")
    points, normals = corpus[index]
    first = np.arange(protocol.points) % len(points)
    return _make_pair(
        corpus.names[index],
        points,
        normals,
        protocol,
        reseed=lambda: np.random.RandomState(index),
        shared=lambda _: first,
    )


def random_pair(
    points: Float32[np.ndarray, "p 3"],
    normals: Float32[np.ndarray, "p 3"],
    protocol: Protocol,
    rng: Rng,
    name: str = "",
) -> Pair:
    """A new random pair from a shape, for training."""
    return _make_pair(
        name,
        points,
        normals,
        protocol,
        reseed=lambda: rng,
        shared=lambda rng: resample(len(points), protocol.points, rng),
    )


def _make_pair(
    name: str,
    points: Float32[np.ndarray, "p 3"],
    normals: Float32[np.ndarray, "p 3"],
    protocol: Protocol,
    reseed: Callable[[], Rng],
    shared: Callable[[Rng], Int[np.ndarray, " n"]],
) -> Pair:
    """Applies the operations in their published order: source first, except in the shuffle."""
    if protocol.keep is None and protocol.overlap is None and not protocol.noise:
        chosen = shared(reseed())
        points, normals = points[chosen], normals[chosen]
    source_rows = target_rows = np.arange(len(points))
    count = protocol.points
    if protocol.keep is not None:
        rng = reseed()
        source_rows = crop(points, protocol.keep, rng)
        target_rows = crop(points, protocol.keep, rng)
        count = math.ceil(np.float32(protocol.keep) * count)
    elif protocol.overlap is not None:
        source_rows, target_rows = opposite_sides(points, protocol.overlap, reseed())
        count = math.ceil(count / (2 - protocol.overlap))
    overlap = len(np.intersect1d(source_rows, target_rows)) / len(source_rows)

    rng = reseed()
    motion = random_motion(protocol.angle, protocol.translation, rng, both_ways=protocol.both_ways)
    # crop before moving, as published: moving all rows may round the last bit differently
    source = motions.apply(motion, points[source_rows])
    source_normals = motions.rotate(motion, normals[source_rows])
    target, target_normals = points[target_rows], normals[target_rows]

    if protocol.keep is not None or protocol.overlap is not None or protocol.noise:
        rng = reseed()
        chosen = resample(len(source), count, rng)
        source, source_normals = source[chosen], source_normals[chosen]
        chosen = resample(len(target), count, rng)
        target, target_normals = target[chosen], target_normals[chosen]
    if protocol.noise:
        source, target = jitter(source, rng), jitter(target, rng)
    target_order = rng.permutation(len(target))
    source_order = rng.permutation(len(source))

    return Pair(
        name=name,
        source=source[source_order],
        target=target[target_order],
        source_normals=source_normals[source_order],
        target_normals=target_normals[target_order],
        transform=motions.inverse(motion),
        overlap=overlap,
        clean_source=motions.apply(motion, points),
        clean_target=points,
    )
