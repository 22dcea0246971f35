"""Whether normals that came with points can be those of a surface through the points.

Files hold placeholders (0 0 1 in every row), colors and other triples where normals belong. A
network would believe them.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from cfr_jax.geometry.trees import Tree

_LOOKED_AT = 4096  # points; the others of a larger cloud are left out
_ASKED = 512  # of these, evenly spread over the rows
_NEIGHBORS = 12
_NEAREST = 8
_FEWEST = 30  # with fewer points, a neighborhood is most of the cloud
_CONSTANT = 1e-3  # as far as one normal lies from another; a plane's have no reason to differ
_THICKNESS = 0.05  # of a plane, as a share of its extent
# A neighborhood tells a normal if its variance across is no more than this share of the middle one.
_FLAT = 0.25
# Chosen on 465 shapes of the validation corpus, with 120 to 717 points, noisy and not. Directions
# drawn at random, and colors, stay below the first and above the second in 99 of 100 clouds. Of
# right normals, one test alone would refuse up to a tenth: of thin parts that are sampled coarsely.
_AGREES = 0.66  # median cosine, without its sign, with the normals of neighborhoods
_STEEP = 0.42  # median cosine, without its sign, with the directions to the nearest points


def contradict(points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> bool:
    """Whether unit normals cannot be those of a surface through the points, whatever their signs.

    That is so if all are the same and the points lie on no plane across them; or if they neither
    agree with the principal components of neighborhoods nor stand across the directions to the
    nearest points. False where the points do not tell: fewer than 30, or no surface among them.

    Signs are not judged: those of thin sheets, seen from both sides, look as if drawn at random.
    """
    if len(points) < _FEWEST:
        return False
    chosen = np.sort(np.random.default_rng(0).permutation(len(points))[:_LOOKED_AT])
    points, normals = points[chosen], normals[chosen]
    if np.abs(normals - normals[0]).max() < _CONSTANT:
        return not _flat_across(points, normals[0])
    asked = np.arange(0, len(points), -(-len(points) // _ASKED))
    near, _ = Tree(points).nearest(points[asked], _NEIGHBORS + 1)
    offset = points[near] - points[near].mean(axis=1, keepdims=True)
    spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset))
    flat = (spread[:, 0] <= _FLAT * spread[:, 1]) & (spread[:, 1] > 0)
    away = points[near[:, 1 : 1 + _NEAREST]] - points[asked, None]
    distance = np.linalg.norm(away, axis=2)
    apart = distance > 0
    if not flat.any() or not apart.any():
        return False
    agreement = np.abs(np.sum(axes[:, :, 0] * normals[asked], axis=1))
    cosines = np.abs(np.einsum("nki,ni->nk", away, normals[asked])) / np.where(apart, distance, 1)
    return bool(np.median(agreement[flat]) < _AGREES and np.median(cosines[apart]) > _STEEP)


def _flat_across(points: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, " 3"]) -> bool:
    def width(values: np.ndarray) -> float:
        low, high = np.quantile(values, [0.1, 0.9])
        return float(high - low)

    extent = max(width(points[:, axis]) for axis in range(3))
    return width(points @ normal) <= _THICKNESS * extent
