"""Pairs, and answers to them that cost nothing, for the tests of batches."""

from __future__ import annotations

from pathlib import Path

import cli_samples
import numpy as np

from cfr_jax import io
from cfr_jax.batch.stream import Outcome

# All of one padded size (128) and more than the network's 64 neighbors: one program serves them.
SIZES = (90, 101, 75, 120, 88)


def write_pairs(folder: Path, count: int = 5) -> Path:
    """`count` pairs of small clouds and the list of them."""
    lines = ["source,target"]
    for i in range(count):
        names = f"s{i}.ply", f"t{i}.xyz"
        lines.append(",".join(names))
        for name, points in zip(names, pair(i), strict=True):
            io.write(folder / name, io.PointCloud(points))
    listed = folder / "pairs.csv"
    listed.write_text("\n".join(lines) + "\n")
    return listed


def pair(i: int) -> tuple[np.ndarray, np.ndarray]:
    """Two samplings of one surface, the second moved by `cli_samples.motion()`."""
    size, motion = SIZES[i % len(SIZES)], cli_samples.motion()
    target = cli_samples.points(size + 5, 2 * i + 1) @ motion[:3, :3].T + motion[:3, 3]
    return cli_samples.points(size, 2 * i), target


def answered(index: int) -> Outcome:
    """An answer that `align_many` might give."""
    cloud = io.PointCloud(cli_samples.points(12, index))
    return Outcome(index, cli_samples.alignment(cloud, cloud), None)


def quick(pairs, **options):
    """Stands in for `align_many`: reads the files, and answers at once."""
    for index, held in enumerate(pairs):
        try:
            source, target = held() if callable(held) else held
            io.as_point_cloud(source, name="source")
            io.as_point_cloud(target, name="target")
        except ValueError as error:
            yield Outcome(index, None, str(error))
        else:
            yield answered(index)
