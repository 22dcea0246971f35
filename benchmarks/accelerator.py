r"""Measures one machine in one call: python benchmarks/accelerator.py [--minutes 5]

It measures the limits of arithmetic and memory, `register` at several sizes and batches, `align`
and its parts, the last refinement on the host, a training step with the drawing of its pairs,
kernels per call and compile seconds, and checks that the results agree with the CPU's. It writes
accelerator.json and a Markdown table, with the device and versions. With `--authors CHECKOUT` the
authors' PyTorch programs run on the same clouds and device. Everything also runs on a CPU. The most
important lines are measured first; lines that no longer fit into the time are listed.

For a machine that is lent for a few minutes: everything in one call of less than six minutes, with
all results in one archive:

    mkdir -p out && timeout 350 python benchmarks/accelerator.py --minutes 4.8 --steps 10 \
        --out out/accelerator.json > out/log.txt 2>&1; tar czf accelerator.tgz out
"""

from __future__ import annotations

import argparse
import json
import platform
import tempfile
import time
from pathlib import Path

import clouds
import jax
import jax.numpy as jnp
import numpy as np
import peers
import small_gicp
import train_drawn
from device_profile import profile
from timing import Clock

import cfr_jax as cfr
from cfr_jax.alignment import refining, solving
from cfr_jax.alignment.align import checked_params
from cfr_jax.alignment.answers import answer
from cfr_jax.alignment.case import Case
from cfr_jax.alignment.planning import planned
from cfr_jax.evaluation import machine
from cfr_jax.geometry.trees import cores
from cfr_jax.refine import find
from cfr_jax.runtime import programs

HERE = Path(__file__).parent
SIZES = ((717, 1), (12000, 1), (717, 32), (2048, 1), (4000, 1), (717, 8))
RUNS = 15
EACH = 30.0  # seconds that a line may need, mostly for compiling


def main() -> None:
    """Measures line by line and writes the results."""
    args = _arguments()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    clock = Clock(60 * args.minutes)
    found = {
        "machine": machine.describe(),
        "device": jax.devices()[0].device_kind,
        "devices": len(jax.devices()),
        "versions": machine.versions() | {"python": platform.python_version()},
        "commit": machine.commit(),
        "date": time.strftime("%Y-%m-%d"),
        "lines": [],
    }

    def add(name, measure, **about):
        """Measures one line. A failure is recorded in it and does not stop the others."""
        if not clock.has(EACH, name):
            return
        began = time.monotonic()
        try:
            line = measure()
        except Exception as error:  # any library may fail, and the other lines must still run
            line = {"failure": f"{type(error).__name__}: {str(error)[:300]}"}
        line = {"name": name, **about, **line, "took": round(time.monotonic() - began, 1)}
        found["lines"].append(line)
        print(json.dumps(line), flush=True)
        args.out.write_text(json.dumps(found, indent=1) + "\n", "utf-8")

    sizes = SIZES if jax.default_backend() != "cpu" else SIZES[:1] + SIZES[3:4]

    def registers(some):
        for points, batch in some:
            add("register", lambda n=points, b=batch: register(n, b), points=points, batch=batch)

    def trainings(precision):
        for batch in args.training:
            add(
                "training, drawn on the device",
                lambda b=batch: training(precision, b, args.steps),
                precision=precision,
                batch=batch,
            )

    add("roofs", roofs)
    registers(sizes[:1])
    add("align", align, points=1024)
    add("parts of align", align_parts, points=1024)
    for points in (12_000, 100_000):
        add("last refinement", lambda n=points: last_refinement(n), points=points)
    registers(sizes[1:3])
    trainings("bfloat16")
    add("same answers as the CPU", agreement, points=717)
    registers(sizes[3:])
    add("register, neighbors given", lambda: register(717, 1, given=True), points=717, batch=1)
    trainings("tensorfloat32")
    trainings("float32")
    for checkout in args.authors:
        for points, batch in sizes:
            add(
                checkout.name,
                lambda c=checkout, n=points, b=batch: authors(c, n, b),
                points=points,
                batch=batch,
            )
    found["left_out"] = clock.left_out
    args.out.write_text(json.dumps(found, indent=1) + "\n", "utf-8")
    table = as_table(found)
    args.out.with_suffix(".md").write_text(table, "utf-8")
    print(table)


def timed(call, runs: int = RUNS) -> dict:
    """Median and fastest milliseconds of a call, including the wait for its results."""
    jax.block_until_ready(call())
    times = []
    for _ in range(runs):
        began = time.perf_counter()
        jax.block_until_ready(call())
        times.append(1e3 * (time.perf_counter() - began))
    return {"ms": round(float(np.median(times)), 3), "fastest": round(min(times), 3), "runs": runs}


def roofs() -> dict:
    """TFLOP/s of a large matrix product at each precision, and TB/s of a copy (read and write)."""
    side = 8192 if jax.default_backend() != "cpu" else 2048
    key = jax.random.key(0)
    found = {}
    for name, kind, precision in (
        ("float32", jnp.float32, "highest"),
        ("default", jnp.float32, "default"),
        ("bfloat16", jnp.bfloat16, "default"),
    ):
        matrix = jax.random.normal(key, (side, side)).astype(kind)
        product = jax.jit(lambda a, p=precision: jnp.matmul(a, a, precision=p))
        seconds = timed(lambda m=matrix, f=product: f(m), 5)["ms"] / 1e3
        found[f"{name}_tflops"] = round(2 * side**3 / seconds / 1e12, 3)
    block = jnp.ones(2**28 if side == 8192 else 2**24, jnp.float32)
    copy = jax.jit(lambda a: a + 1)
    seconds = timed(lambda: copy(block), 5)["ms"] / 1e3
    return found | {"copy_tbs": round(2 * block.nbytes / seconds / 1e12, 4)}


def pair(points: int, batch: int) -> list[jax.Array]:
    """Both clouds with normals, (n, 6) or (batch, n, 6), on the device."""
    made = []
    for cloud in clouds.pair(points):
        normals = cfr.prepare(jnp.asarray(cloud)).normals
        rows = jnp.concatenate([jnp.asarray(cloud), normals], axis=1)
        made.append(jnp.stack([rows] * batch) if batch > 1 else rows)
    return jax.block_until_ready(made)


def register(points: int, batch: int, given: bool = False) -> dict:
    """The whole network on clouds with normals. It searches the neighbors itself unless `given`."""
    params, arguments = cfr.load_params(), pair(points, batch)
    if given:
        arguments = [cfr.prepare(cloud) for cloud in arguments]

    def solve(params, source, target):
        return cfr.register(params, source, target).transforms

    program = jax.jit(solve if batch == 1 else jax.vmap(solve, (None, 0, 0)))
    lowered, compiled, seconds = compile_apart(program, params, *arguments)
    found = timed(lambda: compiled(params, *arguments), RUNS if points < 5000 else 5)
    kernels = profile(lambda: compiled(params, *arguments))
    memory = compiled.memory_analysis()
    scratch = {} if memory is None else {"scratch_mib": memory.temp_size_in_bytes >> 20}
    return (
        found | seconds | kernels | scratch | {"pairs_per_s": round(1e3 * batch / found["ms"], 1)}
    )


def compile_apart(program, *arguments):
    """Lowers and compiles a jitted function; returns both results and the seconds of each."""
    began = time.perf_counter()
    lowered = program.lower(*arguments)
    middle = time.perf_counter()
    compiled = lowered.compile()
    seconds = {
        "lower_s": round(middle - began, 2),
        "compile_s": round(time.perf_counter() - middle, 2),
    }
    return lowered, compiled, seconds


def align() -> dict:
    """`align` on arrays in host memory, with both clouds at its default budget."""
    source, target = clouds.pair(1024)
    first = cfr.align(source, target, second_look=False)
    found = timed(lambda: cfr.align(source, target, second_look=False).transform)
    return found | {"compile_s": round(first.seconds["compile"], 2)}


def align_parts() -> dict:
    """The same call taken apart, each part waited for: milliseconds on the host and on the device,
    and what the program is without its refinement."""
    source, target = clouds.pair(1024)
    params = checked_params(None)

    def plan(search):
        return planned(source, target, whole=True, search=search)

    made = plan(not solving.on_accelerator())
    sides = solving.on_device(made.source, made.target)

    def program(refine):
        run = programs.compiled(solving.solve_pair, params, *sides, refine=refine)
        return lambda: run(params, *sides)

    whole, bare = program(find(True)), program(None)
    found = jax.block_until_ready(whole())
    fetched = jax.device_get(found)
    case = Case(params, made, fetched)
    parts = {
        "prepare": lambda: plan(not solving.on_accelerator()) and None,
        "prepare, neighbors on the host": lambda: plan(True) and None,
        "upload": lambda: solving.on_device(made.source, made.target),
        "look up the program": lambda: program(find(True)) and None,
        "program": whole,
        "program without refinement": bare,
        "answer": lambda: answer(case) and None,
    }
    found = {name: timed(call)["ms"] for name, call in parts.items()}
    times = []
    for _ in range(RUNS):  # arrays keep what was fetched of them
        result = jax.block_until_ready(whole())
        began = time.perf_counter()
        jax.device_get(result)
        times.append(1e3 * (time.perf_counter() - began))
    found["fetch"] = round(float(np.median(times)), 3)
    parts = {f"{name}_ms": value for name, value in found.items()}
    bare_kernels = {f"bare_{name}": value for name, value in profile(bare).items()}
    return {"leaves": len(jax.tree.leaves(fetched))} | parts | profile(whole) | bare_kernels


def last_refinement(points: int) -> dict:
    """The refinement on all points and what is measured on them, on the host, beside small_gicp
    from the same start: its own trees, covariances and descent, with as many threads."""
    source, target = clouds.pair(points)
    plan = planned(source, target, whole=True, search=not solving.on_accelerator())
    case = solving.solve_case(Case(checked_params(None), plan), refine=find(True))
    ours = timed(
        lambda: refining.refine_every_point(case, refine=find("all_points")).found.transform, 5
    )
    sides, start = refining.every_point(plan), np.asarray(case.found.transform, np.float64)

    def theirs():
        small_gicp.align(
            sides[1].points,
            sides[0].points,
            init_T_target_source=start,
            downsampling_resolution=1e-6,  # no two points share a voxel
            max_correspondence_distance=0.02,
            num_threads=cores(),
        )

    alone = timed(theirs, 5)["ms"]
    return ours | {"small_gicp_ms": alone, "times": round(ours["ms"] / alone, 2)}


def agreement() -> dict:
    """Largest difference between the device's and the CPU's transforms, at full precision.

    Also says whether the same call gives the same bits twice.
    """
    params, arguments = cfr.load_params(), pair(717, 1)

    def solve(params, source, target):
        with jax.default_matmul_precision("float32"):
            return cfr.register(params, source, target).transforms

    on_device = [np.asarray(jax.jit(solve)(params, *arguments)) for _ in range(2)]
    cpu = jax.devices("cpu")[0]
    moved = jax.device_put((params, *arguments), cpu)
    with jax.default_device(cpu):
        wanted = np.asarray(jax.jit(solve)(*moved))
    return {
        "off_by": float(np.abs(on_device[0] - wanted).max()),
        "same_twice": bool((on_device[0] == on_device[1]).all()),
    }


def training(precision: str, batch: int, steps: int) -> dict:
    """A full-size training step on pairs drawn on the device, and the share of the drawing."""
    sizes = {"points": 717, "neighbors": 64, "batch": batch, "steps": steps, "repeats": 3}
    found = train_drawn.measure(precision, **sizes)
    alone = train_drawn.measure_drawing(**sizes)["ms_per_step"]
    step = found.pop("ms_per_step")
    return {"ms": step, "drawing_ms": alone, "drawing_share": round(alone / step, 3)} | found


def authors(checkout: Path, points: int, batch: int) -> dict:
    """The authors' program on the same clouds, on the GPU if there is one."""
    rows = [np.asarray(cloud).reshape(batch, points, 6) for cloud in pair(points, batch)]
    device = "cuda" if jax.default_backend() == "gpu" else "cpu"
    with tempfile.TemporaryDirectory() as folder:
        found = peers.authors(checkout, *rows, Path(folder), device)
    if "failure" in found:
        return found
    times = found["milliseconds"]
    return {"ms": round(float(np.median(times)), 3), "fastest": round(min(times), 3)}


def as_table(found: dict) -> str:
    """The lines as Markdown."""
    about = f"{found['device']}, jax {found['versions']['jax']}, commit {found['commit']}"
    rows = [f"{about}, {found['date']}", "", "| what | ms | more |", "|---|---|---|"]
    for line in found["lines"]:
        given = [f"{k} {line[k]}" for k in ("points", "batch", "precision") if k in line]
        skipped = {"name", "ms", "points", "batch", "precision"}
        more = "; ".join(f"{k} {v}" for k, v in line.items() if k not in skipped)
        rows.append(f"| {', '.join([line['name'], *given])} | {line.get('ms', '')} | {more} |")
    rows += [f"left out: {', '.join(found['left_out'])}"] if found["left_out"] else []
    return "\n".join(rows) + "\n"


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=5.0, help="start no line after this time")
    parser.add_argument(
        "--out", type=Path, default=HERE / "results" / "accelerator.json",
        help="the JSON file, written after every line; the table goes beside it, as .md",
    )  # fmt: skip
    parser.add_argument(
        "--training", type=int, nargs="*", default=[64], metavar="BATCH",
        help="batch sizes of the training steps; give none to skip them",
    )  # fmt: skip
    parser.add_argument("--steps", type=int, default=10, help="training steps in one program")
    parser.add_argument(
        "--authors", type=Path, action="append", default=[], metavar="CHECKOUT",
        help="a checkout of the authors' CFR or RPM-Net in PyTorch; may be given twice",
    )  # fmt: skip
    return parser.parse_args()


if __name__ == "__main__":
    main()
