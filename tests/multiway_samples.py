"""Pose graphs and scans whose true poses are known."""

from __future__ import annotations

import itertools

import numpy as np
import solids
from scipy.spatial.transform import Rotation

from cfr_jax.geometry import motions, twists
from cfr_jax.multiway.pose_graph.graph import Edges
from cfr_jax.multiway.scans import Scan, load


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


def scans_of_a_solid(count: int, seed: int, flat: bool = False) -> tuple[list[Scan], np.ndarray]:
    """Scans of one box with a corner cut out (or of a plane), each turned its own way, and the
    poses of the centered scans in the frame of the first."""
    rng = np.random.default_rng(seed)
    poses = some_poses(count, seed)
    clouds = []
    for pose in poses:
        drawn = rng.uniform(-1, 1, (4000, 3)) * (1.0, 0.7, 0.5)
        if flat:
            points = drawn[:2000] * (1, 1, 0)
        else:
            sides = np.array((1.0, 0.7, 0.5))
            axis = rng.integers(3, size=len(drawn))
            rows = np.arange(len(drawn))
            drawn[rows, axis] = sides[axis] * rng.choice([-1.0, 1.0], len(drawn))
            points = drawn[(drawn > 0).sum(axis=1) < 3]
        points = points + rng.normal(0, 0.003, points.shape)
        back = np.eye(4) if flat else motions.inverse(pose)
        clouds.append(motions.apply(back, points))
    scans = [
        scan
        for scan in load(clouds, [f"scan {row}" for row in range(count)], seed=0)
        if isinstance(scan, Scan)
    ]
    centered = np.stack(
        [
            motions.inverse(motions.motion(np.eye(3), scans[0].center))
            @ pose
            @ motions.motion(np.eye(3), scan.center)
            for pose, scan in zip(poses, scans, strict=True)
        ]
    )
    return scans, centered


def views_of_a_solid(
    count: int, points: int = 420, seed: int = 0
) -> tuple[list[np.ndarray], np.ndarray]:
    """Scans of the lopsided solid, each without the fifth that faces away from it, and the motions
    that bring them back."""
    rng = np.random.default_rng(seed)
    clouds, poses = [], []
    for row in range(count):
        cloud = solids.lopsided(2 * points, seed + row, 0.002).points
        direction = Rotation.from_euler("z", 360 * row / count, degrees=True).apply((1.0, 0.3, 0.2))
        along = cloud @ direction
        cloud = cloud[along > np.quantile(along, 0.2)][:points]
        pose = motions.motion(
            Rotation.from_rotvec(rng.uniform(-0.4, 0.4, 3)).as_matrix(), rng.uniform(-1, 1, 3)
        )
        clouds.append(motions.apply(motions.inverse(pose), cloud))
        poses.append(pose)
    return clouds, np.stack(poses)
