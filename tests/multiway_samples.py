"""Pose graphs and scans whose true poses are known."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.spatial.transform import Rotation

from cfr_jax.geometry import motions, twists
from cfr_jax.multiway.graph import Edges


def some_poses(count: int, seed: int) -> np.ndarray:
    """Poses anywhere; the first is the identity."""
    rng = np.random.default_rng(seed)
    turns = Rotation.random(count, rng=rng).as_matrix()
    poses = motions.motion(turns, rng.normal(size=(count, 3)))
    poses[0] = np.eye(4)
    return poses


def graph_of(
    poses: np.ndarray, *, noise: float, seed: int = 0, ahead: int = 3, ring: bool = True
) -> Edges:
    """Edges between poses and the next ones, each with noise of its own covariance."""
    rng = np.random.default_rng(seed)
    count = len(poses)
    pairs = [
        (row, (row + gap) % count)
        for gap in range(1, ahead + 1)
        for row in range(count)
        if ring or row + gap < count
    ]
    pairs = [(b, a) if flip else (a, b) for (a, b), flip in
             zip(pairs, rng.random(len(pairs)) < 0.5, strict=True)]  # fmt: skip
    source, target = np.array(pairs).T
    spread = rng.normal(size=(len(pairs), 6, 6))
    scale = max(noise, 1e-2) ** 2
    covariance = scale * (0.3 * spread @ spread.swapaxes(-1, -2) / 6 + 0.5 * np.eye(6))
    drawn = np.einsum(
        "eij,ej->ei", np.linalg.cholesky(covariance), rng.normal(size=(len(pairs), 6))
    )
    true = twists.inverse(poses[target]) @ poses[source]
    measured = true @ twists.exp(-drawn if noise else 0 * drawn)
    return Edges(source, target, measured, np.linalg.inv(covariance))


def with_wrong(edges: Edges, rows: np.ndarray, seed: int) -> Edges:
    """The same edges, some of them with a random motion instead."""
    rng = np.random.default_rng(seed)
    transform = edges.transform.copy()
    turns = Rotation.random(len(rows), rng=rng).as_matrix()
    transform[rows] = motions.motion(turns, rng.normal(size=(len(rows), 3)))
    return Edges(edges.source, edges.target, transform, edges.information)


def first_only(count: int) -> np.ndarray:
    """Marks the first of `count` scans."""
    return np.arange(count) == 0


def distances(found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Length of the twist between each two poses."""
    return np.linalg.norm(twists.log(twists.inverse(wanted) @ found), axis=1)


def all_pairs(count: int) -> list[tuple[int, int]]:
    """Each two of `count` scans."""
    return list(itertools.combinations(range(count), 2))
