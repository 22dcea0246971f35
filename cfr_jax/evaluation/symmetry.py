"""Nearly symmetric shapes, which fit on themselves in another position almost as well.

No method can know which position is meant. The rule looks only at the whole shape, never at an
answer. A shape counts as nearly symmetric if some rotation of it fits the shape about as closely as
a second sampling of the shape would: if the Chamfer distance between the shape and its rotated copy
is at most `LIMIT` times the distance that sampling alone causes.

The rule tries rotations by 180, 120 and 72 degrees through the centroid, about the principal axes
and the axes of the shape's coordinates. (Every finite rotation group contains a rotation by 360/p
degrees for a prime p, and a continuous group contains all of them.) It improves each rotation by a
few steps of point-to-point ICP.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from cfr_jax.data.pairs import Pair
from cfr_jax.evaluation.store import code_digest
from cfr_jax.geometry import motions
from cfr_jax.runtime.atomic import write_atomically

LIMIT = 2.0
_TURNS = (180.0, 120.0, 72.0)  # degrees
_LEAST = 30.0  # degrees; smaller rotations do not count as another position
_SOME = 512  # points that choose among the rotations
_TRIED = 4  # rotations that are improved
_STEPS = 10


def nearly_symmetric(pairs: Sequence[Pair], cache: Path) -> Bool[np.ndarray, " p"] | None:
    """Which pairs show nearly symmetric shapes; None if the pairs have no whole shapes.

    The file `cache` keeps the results, by the points of the shape and the rule.
    """
    if any(pair.clean_target is None for pair in pairs):
        return None
    found = json.loads(cache.read_text()) if cache.exists() else {}
    rule = code_digest("evaluation/symmetry.py").encode()
    shapes = [np.asarray(pair.clean_target, np.float64) for pair in pairs]
    keys = [hashlib.sha256(rule + points.tobytes()).hexdigest()[:16] for points in shapes]
    todo = {k: points for k, points in zip(keys, shapes, strict=True) if k not in found}
    if todo:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            ratios = tqdm(pool.map(asymmetry, todo.values()), "symmetries", len(todo), disable=None)
            found |= dict(zip(todo, ratios, strict=True))
        cache.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(cache, json.dumps(found).encode())
    return np.array([found[key] <= LIMIT for key in keys])


def asymmetry(points: Float[np.ndarray, "n 3"]) -> float:
    """Chamfer distance of a shape to its best rotated copy, divided by that of two samplings of it.

    Both are squared distances, summed over both directions. The second is estimated as twice the
    mean squared distance from a point to its nearest neighbor. The ratio is about 1 for a symmetric
    shape. For a shape without extent it would be 0 / 0, and is 1.
    """
    points = np.asarray(points, np.float64)
    points = points - points.mean(axis=0)
    tree = cKDTree(points)
    sampling = 2 * np.square(tree.query(points, 2)[0][:, 1]).mean()
    if not sampling:
        return 1.0
    some = points[:: max(1, len(points) // _SOME)]
    _, principal = np.linalg.eigh(points.T @ points)
    axes = np.concatenate([principal.T, np.eye(3)])
    turns = [
        motions.from_rotvec(np.radians(angle) * axis)
        for axis, angle in itertools.product(axes, _TURNS)
    ]
    turns.sort(key=lambda turn: float(np.square(tree.query(some @ turn.T)[0]).mean()))
    best = np.inf
    for turn in turns[:_TRIED]:
        rotation, moved = _closer(points, tree, turn)
        if motions.angle_between(motions.motion(rotation), np.eye(4)) < _LEAST:
            continue
        there, back = tree.query(moved)[0], cKDTree(moved).query(points)[0]
        best = min(best, np.square(there).mean() + np.square(back).mean())
    return float(best / sampling)


def _closer(
    points: Float[np.ndarray, "n 3"], tree: cKDTree, rotation: Float[np.ndarray, "3 3"]
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "n 3"]]:
    """The rotation after some steps of ICP, and the points after the whole motion."""
    some = points[:: max(1, len(points) // _SOME)]
    shift = np.zeros(3)
    for _ in range(_STEPS):
        targets = points[tree.query(some @ rotation.T + shift)[1]]
        rotation = Rotation.align_vectors(targets - targets.mean(axis=0), some - some.mean(axis=0))[
            0
        ].as_matrix()
        shift = targets.mean(axis=0) - some.mean(axis=0) @ rotation.T
    return rotation, points @ rotation.T + shift
