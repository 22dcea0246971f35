"""Size of the programs and seconds to compile them, part by part: python benchmarks/compiling.py

For each part of a registration it prints the operations as lowered for this machine and for a CUDA
GPU, the instructions and loops that XLA's CPU compiler makes of them, and the CPU seconds of
tracing and compiling. Operations and instructions do not depend on what else the machine does.
Nothing runs, so one size of clouds stands for all.
"""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

import cfr_jax as cfr
from cfr_jax.alignment.solving import DeviceCloud, solve_pair
from cfr_jax.geometry import neighbors, normals, rigid
from cfr_jax.networks.cfr.iterations import unroll
from cfr_jax.networks.cfr.modules import init_params
from cfr_jax.networks.inputs import Cloud, Settings
from cfr_jax.refine import find
from cfr_jax.training.losses import pair_loss

Program = tuple[Callable[..., Any], tuple[Any, ...]]


def main() -> None:
    """Prints a row of a Markdown table for each part."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=717)
    parser.add_argument("--neighbors", type=int, default=64)
    parser.add_argument("--parts", nargs="+", metavar="PART", help="only these, by name")
    parser.add_argument("--no-compile", action="store_true", help="only trace and lower")
    args = parser.parse_args()
    known = parts(args.points, args.neighbors)
    wanted = args.parts or list(known)
    if unknown := sorted(set(wanted) - set(known)):
        parser.error(f"--parts: got {unknown}, wanted some of {list(known)}")
    print("| part | operations, here | for CUDA | instructions | loops | trace, s | compile, s |")
    print("|---|---|---|---|---|---|---|")
    for name in wanted:
        print(f"| {name} | {' | '.join(map(str, measure(*known[name], args)))} |", flush=True)


def measure(function: Callable[..., Any], arguments: tuple, args: argparse.Namespace) -> list[Any]:
    """Operations here and for CUDA, instructions, loops, and CPU seconds to trace and compile."""
    jax.clear_caches()
    began = time.process_time()
    traced = jax.jit(function).trace(*arguments)
    lowered = traced.lower()
    middle = time.process_time()
    row: list[Any] = [
        traced.lower(lowering_platforms=(platform,)).as_text().count(" = stablehlo.")
        for platform in (jax.default_backend(), "cuda")
    ]
    if args.no_compile:
        return [*row, "", "", round(middle - began, 1), ""]
    before = time.process_time()
    text = lowered.compile().as_text()
    seconds = time.process_time() - before
    instructions = re.findall(r"^\s+(?:ROOT )?%?[\w.-]+ = .*?[\])}] ([\w-]+)\(", text, re.MULTILINE)
    loops = instructions.count("while")
    return [*row, len(instructions), loops, round(middle - began, 1), round(seconds, 1)]


def parts(points: int, count: int) -> dict[str, Program]:
    """The parts by name, each as a function and the shapes of its arguments."""
    settings = Settings(neighbors=count)

    def shape(*sizes: int, dtype: Any = jnp.float32) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(sizes, dtype)

    params = jax.eval_shape(lambda: init_params(jax.random.key(0), 5))
    near, mask = shape(points, count, dtype=jnp.int32), shape(points, dtype=bool)
    cloud = Cloud(shape(points, 3), shape(points, 3), near)
    sent = DeviceCloud(shape(points, 3), near, mask)

    def register(params, source, target, cascades=1):
        return cfr.register(params, source, target, cascades=cascades, settings=settings)

    def loss(params, source, target, truth):
        steps = unroll(params, source, target, Settings(neighbors=count, detach_motion=True))
        return pair_loss(steps, source, target, truth, correspondence_weight=0.05).total

    return {
        "neighbors": (lambda x: neighbors.nearest(x, count), (shape(points, 3),)),
        "normals": (normals.estimate_normals, (shape(points, 3), near)),
        "rotation": (rigid.nearest_rotation, (shape(3, 3),)),
        "encode": (lambda p, y: cfr.encode(p, y, settings=settings), (params, cloud)),
        "register": (register, (params, cloud, cloud)),
        "register, two cascades": (lambda *a: register(*a, cascades=2), (params, cloud, cloud)),
        "register, neighbors searched": (register, (params, *2 * (shape(points, 6),))),
        "align": (lambda *a: solve_pair(*a, refine=find(True)), (params, sent, sent)),
        "gradient of a pair": (jax.grad(loss), (params, cloud, cloud, shape(4, 4))),
    }


if __name__ == "__main__":
    main()
