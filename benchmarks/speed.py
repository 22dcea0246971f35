"""How long registering takes: python benchmarks/speed.py [--repeats 20]

On whatever JAX runs on; the clouds are the pair that ships with the package, thinned at random. Run
it on a machine that does nothing else.
"""

from __future__ import annotations

import argparse
import functools
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

import cfr_jax as cfr
from cfr_jax import io
from cfr_jax.neighbors import nearest_on_host

PAIR = Path(cfr.__file__).parent / "demo"
SIZES = (717, 1024, 2048)


def main() -> None:
    """Prints a table: what, points of each cloud, first call, then the repeated ones."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=20)
    repeats = parser.parse_args().repeats

    device = jax.devices()[0].device_kind
    print(f"cfr_jax {cfr.__version__}, jax {jax.__version__}, Python {platform.python_version()}")
    print(f"{device}, {len(os.sched_getaffinity(0))} CPU cores, {repeats} repeats, milliseconds\n")
    print(f"{'what':<40} {'points':>6} {'first':>9} {'median':>9} {'fastest':>9}")
    source, target = (io.read(PAIR / f"{name}.ply").points for name in ("source", "target"))
    for count in SIZES:
        for what, call in calls(source, target, count).items():
            measure(what, count, repeats, call)


def calls(source: np.ndarray, target: np.ndarray, count: int) -> dict[str, Callable[[], object]]:
    """What is measured, on clouds of `count` points."""
    params, settings = cfr.load_params(), cfr.Settings()
    x, y = unit_cloud(source, count), unit_cloud(target, count)

    def search(points):
        return nearest_on_host(points, settings.neighbors, radius=settings.radius)

    near_x, near_y = search(x), search(y)
    align = functools.partial(cfr.align, source, target, params=params, max_points=count)
    return {
        "neighbors of both clouds, on the host": lambda: (search(x), search(y)),
        "register, neighbors given": lambda: cfr.register(
            params, cfr.prepare(x, neighbors=near_x), cfr.prepare(y, neighbors=near_y)
        ),
        "register, neighbors on the device": lambda: cfr.register(params, x, y),
        "align, network alone": lambda: align(refine=False).transform,
        "align, refined": lambda: align(refine=True).transform,
    }


def unit_cloud(points: np.ndarray, count: int) -> np.ndarray:
    """`count` of the points, (count, 3) float32, in the unit sphere."""
    chosen = points[np.random.default_rng(0).choice(len(points), count, replace=False)]
    chosen = chosen - chosen.mean(axis=0)
    return (chosen / np.linalg.norm(chosen, axis=1).max()).astype(np.float32)


def measure(what: str, count: int, repeats: int, call: Callable[[], object]) -> None:
    """Prints one line. The first call may compile; the others do not."""
    times = []
    for _ in range(repeats + 1):
        began = time.perf_counter()
        jax.block_until_ready(call())
        times.append(1e3 * (time.perf_counter() - began))
    first, *others = times
    print(f"{what:<40} {count:>6} {first:>9.1f} {np.median(others):>9.1f} {min(others):>9.1f}")


if __name__ == "__main__":
    main()
