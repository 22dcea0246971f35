"""A training step as a GPU runs it: several in one program, on pairs that the device draws."""

from __future__ import annotations

import time

import jax
import numpy as np
from device_profile import profile
from train_step import ellipsoids

from cfr_jax.data.augment import Sampling
from cfr_jax.data.device_pairs import Shapes, draw_pairs
from cfr_jax.networks.cfr.iterations import unroll
from cfr_jax.networks.cfr.modules import init_params
from cfr_jax.networks.inputs import Settings
from cfr_jax.training import devices, optimizers, step

POINTS, NEIGHBORS = 717, 64


def drawn(precision: str, batch: int, steps: int) -> dict:
    """Milliseconds of a step of `batch` pairs, pairs per second, milliseconds of drawing alone, and
    the share of a stretch of `steps` that the device works."""
    mesh = devices.make_mesh()
    schedule = optimizers.make_schedule("cosine", peak_rate=1e-4, steps=1000, warmup=0.1)
    recipe = step.Recipe(
        unroll=unroll,
        settings=Settings(
            neighbors=NEIGHBORS,
            detach_motion=True,
            activations="bfloat16" if precision == "bfloat16" else "float32",
        ),
        optimizer=optimizers.make_optimizer("adamw", schedule, clip=1.0, weight_decay=1e-5),
        mesh=mesh,
        correspondence_weight=0.05,
        average_decay=0.999,
        pairs_at_once=batch // len(mesh.devices),
        precision=precision,
        max_skipped=20,
    )
    sampling = Sampling(points=POINTS, neighbors=NEIGHBORS)
    shapes, seed = devices.replicate((Shapes.of(ellipsoids()), np.uint32(0)), mesh)
    state = devices.replicate(
        step.init_state(init_params(jax.random.key(0)), recipe.optimizer), mesh
    )
    places = np.arange(steps * batch, dtype=np.uint32).reshape(steps, batch)
    items = (places % 16).astype(np.int32)
    given = [devices.spread_steps(each, mesh) for each in (items, places)]

    began = time.perf_counter()
    lowered = step.train_on_drawn.lower(
        state, shapes, seed, *given, recipe=recipe, sampling=sampling
    )
    lowering = time.perf_counter() - began
    program = lowered.compile()
    compiling = time.perf_counter() - began - lowering
    times = []
    for _ in range(4):
        began = time.perf_counter()
        state, measured = program(state, shapes, seed, *given)
        jax.block_until_ready(measured.total)
        times.append(time.perf_counter() - began)
    seconds = float(np.median(times[1:])) / steps
    held = [state]

    def stretch():
        held[0], measured = program(held[0], shapes, seed, *given)
        return measured.total

    found = profile(stretch)
    if found:
        found["busy"] = round(found["kernel_ms"] / (1e3 * seconds * steps), 3)
    memory = program.memory_analysis()
    return {
        "ms": round(1e3 * seconds, 3),
        "pairs_per_s": round(batch / seconds, 1),
        "drawing_ms": drawing(shapes, seed, given[0][0], given[1][0], sampling),
        "loss": float(np.mean(np.asarray(measured.total))),
        "lower_s": round(lowering, 1),
        "compile_s": round(compiling, 1),
        "scratch_mib": 0 if memory is None else memory.temp_size_in_bytes >> 20,
        **found,
    }


def drawing(shapes, seed, items, places, sampling) -> float:
    """Milliseconds of drawing the pairs of one step alone."""
    program = jax.jit(lambda *given: draw_pairs(*given, sampling))
    times = []
    for _ in range(6):
        began = time.perf_counter()
        jax.block_until_ready(program(shapes, seed, items, places))
        times.append(1e3 * (time.perf_counter() - began))
    return round(float(np.median(times[1:])), 3)
