"""Pairs made from shapes: the published test procedures, and the same operations for training.

All random numbers come from the generator that is passed in, in a fixed order. So `fixed_pair`
repeats, draw by draw, the test set on which RPM-Net (Yew & Lee, 2020) and its successors publish
their results. A generator is numpy's legacy `RandomState` or a `Generator`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float, Float32, Int

from cfr_jax.data.corpus import Corpus
from cfr_jax.data.pairs import Pair
from cfr_jax.geometry import motions
from cfr_jax.runtime.sequences import OnDemand

Rng = np.random.RandomState | np.random.Generator

NOISE_SCALE = 0.01
NOISE_CLIP = 0.05


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


def crop(points: Float[np.ndarray, "p 3"], keep: float, rng: Rng) -> Int[np.ndarray, " kept"]:
    """Rows that a crop keeps: those beyond a plane with a random normal, a share of `keep`.

    For exactly one half the plane goes through the mean, as in the published low-overlap sets, so
    the share is only roughly one half. Raises ValueError if no point is left.
    """
    height = (points - points.mean(axis=0)) @ _direction(rng)
    # The published share is a float32, so in float64 (1 - 0.7) * 100 is not quite 30.
    percentile = (1.0 - float(np.float32(keep))) * 100
    plane = 0.0 if keep == 0.5 else np.percentile(height, percentile)
    kept = np.flatnonzero(height > plane)
    if not len(kept):
        raise ValueError(
            f"points: a crop to {keep} leaves none of {len(points)} points, wanted a cloud whose "
            "points do not coincide"
        )
    return kept


def opposite_sides(
    points: Float[np.ndarray, "p 3"], overlap: float, rng: Rng
) -> tuple[Int[np.ndarray, " kept"], Int[np.ndarray, " kept"]]:
    """Rows of two crops from the two ends of one random direction, which share `overlap` of each.

    Each keeps 1 / (2 - overlap) of the points, so that together they are the whole shape.
    """
    order = np.argsort(points @ _direction(rng), kind="stable")
    kept = round(len(points) / (2 - overlap))
    return np.sort(order[:kept]), np.sort(order[len(points) - kept :])


def _direction(rng: Rng) -> Float[np.ndarray, " 3"]:
    azimuth = rng.uniform(0.0, 2 * np.pi)
    polar = np.arccos(rng.uniform(-1.0, 1.0))
    return np.array(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]
    )


def random_motion(
    angle: float | None, translation: float, rng: Rng, *, both_ways: bool = False
) -> Float32[np.ndarray, "4 4"]:
    """R = Rx Ry Rz with each angle in [0, angle] degrees, then a translation within a cube.

    `both_ways` draws the angles from [-angle, angle]. If `angle` is None, the rotation is uniform
    over SO(3), from a random unit quaternion. Each coordinate of the translation is in
    [-translation, translation].
    """
    motion = np.eye(4)
    if angle is None:
        motion[:3, :3] = motions.from_quaternion(rng.normal(size=4))
    else:
        x, y, z = (rng.uniform() * np.pi * angle / 180.0 for _ in range(3))
        if both_ways:
            x, y, z = (2 * drawn - np.pi * angle / 180.0 for drawn in (x, y, z))
        about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
        about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
        about_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
        motion[:3, :3] = about_x @ about_y @ about_z
    motion[:3, 3] = rng.uniform(-translation, translation, 3)
    return motion.astype(np.float32)


def resample(size: int, count: int, rng: Rng) -> Int[np.ndarray, " count"]:
    """`count` of `size` rows, without repeats; if there are too few, all of them plus repeats."""
    if count <= size:
        return rng.choice(size, count, replace=False)
    return np.concatenate(
        [rng.choice(size, size, replace=False), rng.choice(size, count - size, replace=True)]
    )


def jitter(points: Float32[np.ndarray, "n 3"], rng: Rng) -> Float32[np.ndarray, "n 3"]:
    """Points with clipped Gaussian noise. All protocols leave the normals exact."""
    drawn = rng.normal(0.0, NOISE_SCALE, points.shape)
    return (points + np.clip(drawn, -NOISE_CLIP, NOISE_CLIP)).astype(np.float32)


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
