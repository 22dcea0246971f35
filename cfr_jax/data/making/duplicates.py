"""Finds shapes that occur more than once in a corpus, possibly mirrored or rotated.

Two samples of one surface lie a certain distance apart, the spacing. Two shapes are near duplicates
if their samples lie hardly farther apart than that.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial import cKDTree

from cfr_jax.data.making.shapes import Shape, mean_nearest

Pair = tuple[int, int]  # rows of shapes

NEAR = 1.2  # limit, in multiples of the spacing
NEAR_ACROSS_HALVES = 1.3

# Cheap tests, which nearly all near duplicates of the full test pass. Distances to the center and
# extents along the principal axes do not change under rotation or mirroring.
_QUANTILES = np.linspace(0.02, 0.98, 25)
_RADII_APART = 0.03  # mean over the quantiles
_EXTENTS_APART = 0.04  # largest of the three standard deviations
_PROBES = 128  # points of one cloud that are looked up in the other
_PROBE_SLACK = 1.35  # factor on the limit, because so few points measure it roughly
_FAR = 3.0  # distances are cut off at this multiple of the limit, which makes lookups fast

_SIGNS = np.array(list(itertools.product((1.0, -1.0), repeat=3)))
_MIRRORS = np.stack([np.diag(s) for s in ((1, 1, 1), (-1, 1, 1), (1, -1, 1), (1, 1, -1))])


def drop_duplicates(
    shapes: Sequence[Shape],
    seen: Sequence[bool],
    progress: Callable[[Sequence[Pair]], Iterable[Pair]] = lambda pairs: pairs,
) -> dict[int, int]:
    """The shapes to leave out, as a dict: row → row of the shape that it repeats.

    Among duplicates, the first one stays, but seen categories come before unseen ones. An unseen
    shape is compared with seen ones by the wider limit, so that test shapes are really new to the
    network. `progress` may wrap the pairs to compare, as `tqdm` does.
    """
    order = sorted(range(len(shapes)), key=lambda row: (not seen[row], row))
    rank = {row: place for place, row in enumerate(order)}
    repeats: dict[int, int] = {}
    first_with: dict[str, int] = {}
    for row in order:
        if (first := first_with.setdefault(shapes[row].fingerprint, row)) != row:
            repeats[row] = first

    axes = [_principal_axes(shape.points) for shape in shapes]
    tree = lru_cache(maxsize=512)(lambda row: cKDTree(shapes[row].points))
    for later, earlier in progress(_candidates(shapes, axes, rank)):
        if later in repeats or earlier in repeats:
            continue
        limit = NEAR if seen[later] == seen[earlier] else NEAR_ACROSS_HALVES
        reach = limit * (shapes[later].spacing + shapes[earlier].spacing) / 2
        poses = np.concatenate([_MIRRORS, _alignments(axes[later], axes[earlier])])
        moved = shapes[later].points @ poses.transpose(0, 2, 1)
        probes = moved[:, :: max(1, moved.shape[1] // _PROBES)]
        apart = tree(earlier).query(probes, distance_upper_bound=_FAR * reach)[0]
        apart = np.minimum(apart, _FAR * reach).mean(axis=1)
        for pose in np.argsort(apart):
            if apart[pose] > _PROBE_SLACK * reach:
                break
            if mean_nearest(moved[pose], shapes[earlier].points) < reach:
                repeats[later] = earlier
                break
    return repeats


def _candidates(
    shapes: Sequence[Shape], axes: Sequence[Float64[np.ndarray, "3 3"]], rank: dict[int, int]
) -> list[Pair]:
    """Pairs (later, earlier) by rank that are alike in measures that do not depend on the pose."""
    if not shapes:
        return []
    radii = np.stack(
        [np.quantile(np.linalg.norm(shape.points, axis=1), _QUANTILES) for shape in shapes]
    )
    extents = np.stack([(s.points @ a).std(axis=0) for s, a in zip(shapes, axes, strict=True)])
    reach = _RADII_APART * len(_QUANTILES)
    pairs = cKDTree(radii).query_pairs(reach, p=1, output_type="ndarray")
    alike = np.abs(extents[pairs[:, 0]] - extents[pairs[:, 1]]).max(axis=1) < _EXTENTS_APART
    ranked = [(a, b) if rank[a] > rank[b] else (b, a) for a, b in pairs[alike].tolist()]
    return sorted(ranked, key=lambda pair: (rank[pair[0]], rank[pair[1]]))


def _principal_axes(points: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "3 3"]:
    """The principal axes as columns, in ascending order of the extents along them."""
    return np.linalg.eigh(np.cov(points.T.astype(np.float64)))[1]


def _alignments(
    axes: Float64[np.ndarray, "3 3"], onto: Float64[np.ndarray, "3 3"]
) -> Float64[np.ndarray, "8 3 3"]:
    """Rotations and reflections that map one set of principal axes onto the other."""
    return np.einsum("ik,sk,jk->sij", onto, _SIGNS, axes)
