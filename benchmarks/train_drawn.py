"""Training speed on pairs that the device draws: python benchmarks/train_drawn.py

For each precision it measures the seconds to compile, the pairs per second of one program that
draws pairs and trains on them for several steps, and the share of that time that the drawing takes.
It is made for accelerators; `--points 64 --neighbors 12 --batch 4 --steps 2` is enough to try it on
a CPU.
"""

from __future__ import annotations

import argparse
import functools
import json
import time

import jax
import jax.numpy as jnp
import numpy as np
from device_profile import profile
from train_step import ellipsoids, start

from cfr_jax.data.augmentation.pairs_on_device import Shapes, draw_pairs
from cfr_jax.data.augmentation.sampling import Sampling
from cfr_jax.networks.cfr.iterations import unroll
from cfr_jax.networks.inputs import Settings
from cfr_jax.training import devices, optimizers, step


def main() -> None:
    """Prints a line of JSON for each precision."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=717)
    parser.add_argument("--neighbors", type=int, default=64)
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--steps", type=int, default=25, help="training steps in one program")
    parser.add_argument("--repeats", type=int, default=4, help="timed runs of that program")
    parser.add_argument("--precisions", nargs="+", default=step.PRECISIONS[::-1])
    args = parser.parse_args()
    print(f"{len(jax.devices())} x {jax.devices()[0].device_kind}, jax {jax.__version__}")
    sizes = {name: vars(args)[name] for name in ("points", "neighbors", "batch", "steps")}
    drawing = measure_drawing(**sizes, repeats=args.repeats)
    for precision in args.precisions:
        found = measure(precision, **sizes, repeats=args.repeats)
        share = drawing["ms_per_step"] / found["ms_per_step"]
        told = {**found, "drawing_ms": drawing["ms_per_step"], "drawing_share": round(share, 3)}
        print(json.dumps(told), flush=True)


def measure(
    precision: str, *, points: int, neighbors: int, batch: int, steps: int, repeats: int
) -> dict:
    """Compile times, and the steady rate of training in `precision` on all devices."""
    mesh = devices.make_mesh()
    schedule = optimizers.make_schedule("trapezoid", peak_rate=1e-3, steps=10_000, warmup=0.02)
    optimizer = optimizers.make_optimizer("muon", schedule, clip=1.0, weight_decay=1e-5)
    settings = Settings(
        neighbors=neighbors,
        detach_motion=True,
        activations="bfloat16" if precision == "bfloat16" else "float32",
    )
    recipe = step.Recipe(
        unroll=unroll,
        settings=settings,
        optimizer=optimizer,
        mesh=mesh,
        correspondence_weight=0.05,
        average_decay=0.999,
        pairs_at_once=batch // mesh.size,
        precision=precision,
        max_skipped=20,
    )
    state, given = start(optimizer, mesh), _placed(batch, steps, mesh)
    began = time.perf_counter()
    lowered = step.train_on_drawn.lower(
        state, *given, recipe=recipe, sampling=_sampling(points, neighbors)
    )
    traced = time.perf_counter()
    program = lowered.compile()
    compiled = time.perf_counter()
    state, measured = program(state, *given)
    jax.block_until_ready(measured.total)
    begun = time.perf_counter()
    for _ in range(repeats):
        state, measured = program(state, *given)
    jax.block_until_ready(measured.total)
    seconds = (time.perf_counter() - begun) / (repeats * steps)
    held = [state]

    def stretch():  # the state is donated, so each call passes the new one on
        held[0], measured = program(held[0], *given)
        return measured.total

    seen = profile(stretch)
    if seen:
        seen["busy"] = round(seen["kernel_ms"] / (1e3 * seconds * steps), 3)
    return {
        "precision": precision,
        "batch": batch,
        "points": points,
        "neighbors": neighbors,
        "pairs_per_second": round(batch / seconds, 1),
        "ms_per_step": round(1e3 * seconds, 3),
        "trace_s": round(traced - began, 1),
        "compile_s": round(compiled - traced, 1),
        "scratch_GiB": round(program.memory_analysis().temp_size_in_bytes / 2**30, 2),
        "loss": float(jnp.mean(measured.total)),
        "skipped": int(held[0].skipped),
        **seen,
    }


def measure_drawing(*, points: int, neighbors: int, batch: int, steps: int, repeats: int) -> dict:
    """The time to draw one device's share of a batch, without training."""
    mesh = devices.make_mesh()
    shapes, seed, items, positions = _placed(batch, steps, mesh)
    share = batch // mesh.size
    rows = jnp.asarray(np.asarray(items)[0, :share]), jnp.asarray(np.asarray(positions)[0, :share])

    @functools.partial(jax.jit, static_argnames=("sampling",))
    def draw(shapes, seed, items, positions, sampling):
        pairs = draw_pairs(shapes, seed, items, positions, sampling)
        return jax.tree.map(lambda leaf: leaf.astype(jnp.float32).sum(), pairs)

    one = jax.device_put((jax.tree.map(np.asarray, shapes), np.asarray(seed)))
    run = functools.partial(draw, *one, *rows, sampling=_sampling(points, neighbors))
    jax.block_until_ready(run())
    began = time.perf_counter()
    for _ in range(repeats * steps):
        found = run()
    jax.block_until_ready(found)
    seconds = (time.perf_counter() - began) / (repeats * steps)
    return {"ms_per_step": round(1e3 * seconds, 3)}


def _sampling(points: int, neighbors: int) -> Sampling:
    """The sampling of configs/object.py."""
    return Sampling(
        points=points, neighbors=neighbors, keep=(0.55, 0.85), both_ways=0.5, near=0.3,
        centered=0.4, any_orientation=0.3, scale=(0.8, 1.2), estimated_normals=0.6,
    )  # fmt: skip


def _placed(batch: int, steps: int, mesh) -> tuple:
    shapes, seed = devices.replicate((Shapes.of(ellipsoids()), np.uint32(0)), mesh)
    places = np.arange(steps * batch).reshape(steps, batch)
    items, positions = (places % len(ellipsoids())).astype(np.int32), places.astype(np.uint32)
    return shapes, seed, *(devices.spread_steps(rows, mesh) for rows in (items, positions))


if __name__ == "__main__":
    main()
