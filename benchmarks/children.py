"""Measurements that need a fresh process: peak memory, and start-up time of the command."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import cfr_jax as cfr

_JAX = ("-c", "import jax; jax.numpy.ones(3).sum()")


def peak_memory(count: int, timeout: float) -> dict:
    """Peak memory, in mebibytes, of registering one pair of `count` points and of imports alone.

    Neighbors are found on the host and normals are estimated. Works on Linux only (it reads /proc).
    """
    peaks = {}
    for name, points in (("imports", 0), ("register", count)):
        child = subprocess.run(
            [sys.executable, __file__, str(points)], capture_output=True, text=True, timeout=timeout
        )
        child.check_returncode()
        peaks[name] = float(child.stdout)
    return {"points": count, "peak": peaks["register"], "imports": peaks["imports"]}


def start_up(runs: int) -> dict:
    """Median seconds of `cfr register` on the demo pair with a warm cache.

    They are compared with a process that imports JAX and adds three numbers. The two alternate.
    """
    folder = Path(cfr.__file__).parent
    pair = [str(folder / "cli" / "demo_pair" / f"{name}.ply") for name in ("source", "target")]
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"CFR_JAX_CACHE": cache}
        environment["PYTHONPATH"] = str(folder.parent)
        calls = {"register": ("-m", "cfr_jax", "register", *pair), "jax": _JAX}

        def seconds(name):
            began = time.perf_counter()
            subprocess.run(
                [sys.executable, *calls[name]], env=environment, check=True, capture_output=True
            )
            return time.perf_counter() - began

        first = seconds("register")
        times = {name: [] for name in calls}
        for _ in range(runs):
            for name in calls:
                times[name].append(seconds(name))
    medians = {name: float(np.median(values)) for name, values in times.items()}
    return {
        "first": first,
        "second": medians["register"],
        "jax": medians["jax"],
        "ratio": medians["register"] / medians["jax"],
        "runs": runs,
    }


def _register(count: int) -> float:
    """Runs in the child: registers, and returns the peak memory in mebibytes."""
    if count:
        import clouds
        import jax
        from cases import search

        pair = [cfr.prepare(c, neighbors=search(c)) for c in clouds.pair(count)]
        jax.block_until_ready(cfr.register(cfr.load_params(), *pair))
    else:
        import jax

        cfr.load_params()
        jax.numpy.ones(3).sum().block_until_ready()
    # not getrusage, whose peak includes that of the process that forked this one
    status = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) for line in status if line.startswith("VmHWM")) / 1024


if __name__ == "__main__":
    print(_register(int(sys.argv[1])))
