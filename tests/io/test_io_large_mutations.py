"""Damaged files of up to 50 MB stay within the budget that whole ones have (`test_io_budget`).

Half of them are files that grow when they are read, and half are clouds as `write` leaves them.
`python tests/io/test_io_large_mutations.py 4000 SEED` tries more of them.
"""

from __future__ import annotations

import json
import math
import os
import random
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from amplifiers import makers
from io_samples import write_las
from mutants import mutate_part
from test_io_budget import (
    excesses,
    in_a_fork,
    know_formats_of_corpora,
    read_and_measure,
    read_quietly,
)

LARGEST = 50_000_000
EACH = 8  # of the mutants are made from one file


def _plain(suffix: str) -> Callable[[int, random.Random], bytes]:
    """Clouds of about `size` bytes, of chance points with normals."""

    def make(size: int, rng: random.Random) -> bytes:
        from cfr_jax.io import PointCloud, write

        def written(count: int) -> bytes:
            points, normals = np.random.default_rng(rng.randrange(99)).normal(size=(2, count, 3))
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / f"cloud{suffix}"
                if suffix in (".las", ".laz"):
                    write_las(path, points.round(3), rng.choice((0, 3)))
                else:
                    write(path, PointCloud(points, normals))
                return path.read_bytes()

        return written(max(int(1000 * size / len(written(1000))), 1))

    return make


def all_makers() -> dict[str, Callable[[int, random.Random], bytes]]:
    plain = (".ply", ".pcd", ".xyz", ".csv", ".npy", ".npz", ".las", ".laz")
    return makers() | {f"plain{suffix}": _plain(suffix) for suffix in plain}


def _make(path: Path, name: str, size: int, seed: str) -> dict:
    path.write_bytes(all_makers()[name](size, random.Random(seed)))
    return {"size": path.stat().st_size}


def _damage_and_read(path: Path, data: bytes, seed: str) -> dict:
    generator = random.Random(seed)
    data = mutate_part(data, generator)
    path.write_bytes(data)
    size = len(data)
    del data
    return {"size": size} | read_and_measure(path, whole=generator.random() < 0.5)


def run_cases(cases: int, seed: int) -> dict:
    """Reads that many damaged files, and tells what was wrong about how that went."""
    know_formats_of_corpora()
    warnings.simplefilter("ignore")
    costs: dict[str, dict] = {}
    names = list(all_makers())
    with tempfile.TemporaryDirectory() as folder:
        for name in names:  # what is loaded only once is no cost of a file
            warm = Path(folder) / f"small {name}"
            in_a_fork(_make, warm, name, 3_000, name)
            for whole in (False, True):
                read_quietly(warm, whole)
        for group in range(math.ceil(cases / EACH)):
            name = names[group % len(names)]
            whole, path = Path(folder) / "whole", Path(folder) / name
            size = int(math.exp(random.Random(f"{seed} {group}").uniform(10, math.log(LARGEST))))
            in_a_fork(_make, whole, name, size, f"{seed} {group}")
            data = whole.read_bytes()
            for case in range(group * EACH, min(group * EACH + EACH, cases)):
                told = in_a_fork(_damage_and_read, path, data, f"{seed} {case}")
                costs[f"seed {seed}, case {case}, {name}"] = told
            del data
    return {
        "cases": len(costs), "failures": excesses(costs),
        "refused": sum(bool(cost.get("error")) for cost in costs.values()),
        "bytes": sum(cost.get("size", 0) for cost in costs.values()),
        "largest": max(cost.get("size", 0) for cost in costs.values()),
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="measures memory as Linux tells it")
def test_damaged_files_of_up_to_fifty_megabytes_stay_within_their_budget():
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    child = subprocess.run(
        [sys.executable, __file__, "2000", "0"],
        capture_output=True, text=True, timeout=7200, env=environment,
    )  # fmt: skip

    assert child.returncode == 0, child.stderr[-2000:]
    outcome = json.loads(child.stdout)
    assert outcome["failures"] == []
    assert outcome["cases"] == 2000
    assert 2000 // 4 < outcome["refused"] < 2000  # the damage was neither nothing nor all
    assert outcome["largest"] > 40_000_000


if __name__ == "__main__":
    print(json.dumps(run_cases(int(sys.argv[1]), int(sys.argv[2]))))
