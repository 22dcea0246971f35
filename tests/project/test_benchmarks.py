"""Every benchmark runs, at a size that takes seconds: they speak of the package's insides."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SMALL = {
    "train_step": "--points 64 --neighbors 8 --batch 2 --repeats 1",
    "train_drawn": "--points 64 --neighbors 8 --batch 2 --steps 2 --repeats 1",
    "large": "--points 600 --what register align",
    "compiling": "--points 64 --neighbors 8 --parts rotation normals",
    "run": "--quick --minutes 1 --runs 1",
    "accelerator": "--minutes 0.5 --steps 2",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
def test_a_benchmark_runs(name, tmp_path):
    out = ["--out", str(tmp_path / "out")] if name in ("run", "accelerator") else []
    child = subprocess.run(
        [sys.executable, ROOT / "benchmarks" / f"{name}.py", *SMALL[name].split(), *out],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=900,
    )

    assert child.returncode == 0, child.stdout + child.stderr
    assert len(child.stdout.splitlines()) > 1
