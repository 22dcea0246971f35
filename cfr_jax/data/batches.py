"""Training batches: pairs drawn from a corpus, each from a seed of its own.

Which pair comes when is a function of (seed, position) alone: any number of workers draws the same
pairs, and a run that resumes at step s goes on with the batch that it would have had.
"""

from __future__ import annotations

import collections
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from cfr_jax.data.corpus import Corpus
from cfr_jax.data.protocol import crop, jitter, random_motion, resample, way_back
from cfr_jax.neighbors import nearest_on_host


@dataclass(frozen=True)
class Sampling:
    """How training pairs are drawn; lengths in the unit sphere."""

    points: int = 717
    neighbors: int = 32
    radius: float = 0.3
    keep: tuple[float, float] = (0.7, 0.7)
    """Share of the shape left by the crop of each cloud, drawn evenly."""
    angle: float = 45.0
    translation: float = 0.5
    any_orientation: float = 0.0
    """Share of pairs whose shape is first turned at random: CAD models stand upright, scans not."""
    scale: tuple[float, float] = (1.0, 1.0)
    estimated_normals: float = 0.0
    """Share of pairs whose normals are estimated from the noisy points, as most users' are."""


def draw_pair(corpus: Corpus, index: int, sampling: Sampling, rng: np.random.Generator) -> dict:
    """One training pair as arrays, with its neighbors and the true motion (source onto target)."""
    points, normals = corpus[index]
    if rng.random() < sampling.any_orientation:
        turn = Rotation.random(random_state=rng).as_matrix().astype(np.float32)
        points, normals = points @ turn.T, normals @ turn.T
    points = points * np.float32(rng.uniform(*sampling.scale))
    rows = []
    for _ in range(2):
        kept = crop(points, rng.uniform(*sampling.keep), rng)
        rows.append(kept[resample(len(kept), sampling.points, rng)])
    motion = random_motion(sampling.angle, sampling.translation, rng)
    rotation, translation = motion[:3, :3], motion[:3, 3]
    source = jitter(points[rows[0]] @ rotation.T + translation, rng)
    target = jitter(points[rows[1]], rng)
    return {
        "source": source,
        "source_normals": normals[rows[0]] @ rotation.T,
        "source_neighbors": nearest_on_host(source, sampling.neighbors, radius=sampling.radius),
        "target": target,
        "target_normals": normals[rows[1]],
        "target_neighbors": nearest_on_host(target, sampling.neighbors, radius=sampling.radius),
        "transform": way_back(motion),
        "estimate_normals": rng.random() < sampling.estimated_normals,
    }


def batch_at(corpus: Corpus, position: int, size: int, sampling: Sampling, seed: int) -> dict:
    """The `size` pairs from `position` on of the endless shuffled stream; arrays (size, ...)."""
    pairs = []
    for number in range(position, position + size):
        epoch, place = divmod(number, len(corpus))
        order = np.random.default_rng((seed, epoch)).permutation(len(corpus))
        rng = np.random.default_rng((seed, epoch, place))
        pairs.append(draw_pair(corpus, int(order[place]), sampling, rng))
    return {key: np.stack([pair[key] for pair in pairs]) for key in pairs[0]}


def batches(
    corpus: Corpus,
    sampling: Sampling,
    *,
    size: int,
    position: int,
    count: int,
    seed: int,
    workers: int = 2,
) -> Iterator[dict]:
    """`count` batches from `position` on, made by `workers` threads ahead of their use."""
    with ThreadPoolExecutor(workers) as pool:
        waiting: collections.deque = collections.deque()
        try:
            for number in range(count):
                waiting.append(
                    pool.submit(batch_at, corpus, position + number * size, size, sampling, seed)
                )
                if len(waiting) > 2 * workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for job in waiting:
                job.cancel()
