"""Time and memory for large clouds: python benchmarks/large.py [--points 3000 12000 30000 100000]

Each size runs in its own process, so that the peak memory is that of one registration, including
Python and JAX. The clouds are a lumpy analytic surface, sampled twice and moved. Only the shipped
weights are read. Run it on a machine that does nothing else.

`register` is the network on all points, with neighbors found on the host. From 2^25 affinities on,
its match is streamed: iteration i computes the block i + 1 times, which is 20 times in all. `align`
thins to its budget first and refines on all points at the end; `align thinned` does not.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np

from cfr_jax.geometry.motions import angle_between

FLOP_OF_AN_ENTRY = 20 * 2 * 96  # sweeps, multiply and add, channels
WHAT = ("register", "align thinned", "align")


def main() -> None:
    """Prints one line per size: seconds, memory, the error of the result, and the time's growth."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, nargs="+", default=[3000, 12_000, 30_000, 100_000])
    parser.add_argument("--what", nargs="+", choices=WHAT, default=WHAT)
    parser.add_argument("--alone", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.alone:
        print(json.dumps(measure(args.what[0], args.points[0])))
        return
    print(
        f"{'what':<18} {'points':>7} {'prepare':>8} {'compile':>8} {'run':>8} s {'peak':>6} MB "
        f"{'error':>7} deg  growth"
    )
    for what in args.what:
        before = None
        for points in args.points:
            command = [sys.executable, __file__, "--alone", "--points", str(points), "--what", what]
            child = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
            line = json.loads(child.stdout.splitlines()[-1])
            growth = ""
            if before is not None:
                ratio = line["run"] / before["run"]
                growth = f"N^{math.log(ratio) / math.log(points / before['points']):.2f}"
            if what == "register":
                rate = FLOP_OF_AN_ENTRY * points**2 / line["run"] / 1e9
                growth += f"  ({rate:.0f} GFLOP/s in the match, were it all)"
            print(
                f"{what:<18} {points:>7} {line['prepare']:>8.2f} {line['compile']:>8.1f} "
                f"{line['run']:>8.2f}   {line['peak']:>6.0f}    {line['error']:>7.3f}      "
                f"{growth}",
                flush=True,
            )
            before = line


def measure(what: str, points: int) -> dict[str, float]:
    """Seconds, megabytes and the rotation error of one run in this process."""
    source, target, truth = pair(points)
    run: Callable[[np.ndarray, np.ndarray], dict] = {
        "register": registered,
        "align thinned": lambda x, y: aligned(x, y, all_points=False),
        "align": lambda x, y: aligned(x, y, all_points=True),
    }[what]
    found = run(source, target)
    error = float(angle_between(np.asarray(found.pop("transform"), np.float64), truth))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return {"points": points, "error": error, "peak": peak, **found}


def registered(source: np.ndarray, target: np.ndarray) -> dict:
    """The network on all points."""
    import jax

    import cfr_jax as cfr
    from cfr_jax.geometry.neighbors import nearest_on_host

    settings, params = cfr.Settings(), cfr.load_params()
    began = time.perf_counter()
    clouds = []
    for points in (source, target):
        near = nearest_on_host(points, settings.neighbors, radius=settings.radius, workers=-1)
        clouds.append(jax.block_until_ready(cfr.prepare(points, neighbors=near)))
    prepared = time.perf_counter()
    program = jax.jit(cfr.register).lower(params, *clouds).compile()
    compiled = time.perf_counter()
    found = jax.block_until_ready(program(params, *clouds))
    done = time.perf_counter()
    return {
        "transform": found.transform,
        "prepare": prepared - began,
        "compile": compiled - prepared,
        "run": done - compiled,
    }


def aligned(source: np.ndarray, target: np.ndarray, *, all_points: bool) -> dict:
    """`align` at its default budget."""
    import cfr_jax as cfr

    found = cfr.align(source, target, all_points=all_points)
    seconds = found.seconds
    return {
        "transform": found.transform,
        "prepare": 0.0,
        "compile": seconds["compile"],
        "run": seconds["total"] - seconds["compile"],
    }


def pair(points: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A surface sampled twice, with the source moved by 30 degrees; the truth maps it back."""
    rng = np.random.default_rng(0)
    axis = np.array([0.6, 0.64, 0.48])
    cross = np.array(
        [[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]], np.float64
    )
    angle = math.radians(30)
    turn = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    truth = np.eye(4)
    truth[:3, :3], truth[:3, 3] = turn, [0.1, -0.2, 0.05]
    source = (lumpy_surface(points, rng) - truth[:3, 3]) @ turn
    return source.astype(np.float32), lumpy_surface(points, rng).astype(np.float32), truth


def lumpy_surface(points: int, rng: np.random.Generator) -> np.ndarray:
    """Points on a body without symmetry, in the unit sphere."""
    direction = rng.normal(size=(points, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    x, y, z = direction.T
    radius = 0.55 + 0.15 * np.sin(3 * x) * np.cos(2 * y) + 0.1 * x * z + 0.12 * np.sin(4 * y + z)
    return radius[:, None] * direction * [1.0, 0.8, 0.6]


if __name__ == "__main__":
    main()
