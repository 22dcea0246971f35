"""Measures speed, also as a share of what the machine can do: python benchmarks/run.py [--quick]

It writes benchmarks/results/speed.json, the tables in speed.md next to it, and graphs into
docs/images. Run it on a machine that does nothing else. A large matrix product (the roof) is timed
between the runs of every line and reported with it, so that a disturbed line can be noticed.
"""

from __future__ import annotations

import argparse
import json
import platform
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import cases
import children
import clouds
import jax
import numpy as np
import peers
import report
from timing import Clock, Line, Roof, measure

import cfr_jax as cfr
from cfr_jax.evaluation import machine
from cfr_jax.evaluation.baselines import baseline
from cfr_jax.io import PointCloud

HERE = Path(__file__).parent
SIZES = (717, 2048, 4096, 12000)
LONG = (30000, 100000)
QUICK = (717, 2048, 4096)
BATCHES = (1, 2, 4, 8, 16, 32, 64)
RESERVE = 30.0  # seconds that an unknown case may need, mostly for compiling


def main() -> None:
    """Measures group by group, the most important first, until the time is up."""
    args = _arguments()
    began = time.monotonic()
    clock = Clock(60 * args.minutes)
    args.out.mkdir(parents=True, exist_ok=True)
    roof, lines = Roof(), []
    told = {
        "machine": machine.describe(),
        "device": jax.devices()[0].device_kind,
        "versions": machine.versions() | {"python": platform.python_version()},
        "commit": machine.commit(),
        "quick": args.quick,
        "left_out": clock.left_out,
    }
    for case in planned(args):
        if not clock.has(RESERVE, f"{case.group}: {case.name}, {case.points} points"):
            continue
        call, compiling = case.make()
        line = measure(
            roof,
            call,
            group=case.group,
            name=case.name,
            points=case.points,
            batch=case.batch,
            flop=case.flop,
            compile_seconds=compiling,
            runs=args.runs,
            limit=min(60.0, clock.left()) if case.points <= SIZES[-1] else clock.left(),
            settings=case.settings,
        )
        del call
        jax.clear_caches()
        lines.append(line)
        _print(line)
    lines += list(_peers(args, roof, clock))
    told |= {"start_up": None, "memory": []}
    _save(told, lines, args.out, began)  # saved now, because the processes below may be stopped
    if clock.has(2 * RESERVE, "start-up"):
        told["start_up"] = children.start_up(5 if args.quick else args.runs)
        print(f"start-up {told['start_up']}")
    for count in (*(QUICK[::2] if args.quick else SIZES), *(LONG if args.long else ())):
        if clock.has(2 * RESERVE, f"memory at {count} points"):
            told["memory"].append(children.peak_memory(count, timeout=max(60.0, clock.left())))
            print(f"memory {told['memory'][-1]}")
    _save(told, lines, args.out, began)
    report.write(told, args.out, args.images)


def _save(told: dict, lines: list[Line], out: Path, began: float) -> None:
    told["seconds"] = time.monotonic() - began
    told["lines"] = [line.as_dict() for line in lines]
    (out / "speed.json").write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")


def planned(args: argparse.Namespace) -> Iterator[cases.Case]:
    """The cases that are measured in this process, in order."""
    sizes = QUICK if args.quick else SIZES
    yield from cases.whole(sizes[:1])
    yield from cases.networks(cases.PAPER)
    yield from cases.modules(cases.PAPER)
    yield from cases.batches(cases.PAPER, BATCHES[::5] if args.quick else BATCHES)
    yield from cases.ablations(cases.PAPER)
    yield from cases.whole(sizes[1:])
    if args.long:
        yield from cases.whole(LONG)


def _peers(args: argparse.Namespace, roof: Roof, clock: Clock) -> Iterator[Line]:
    x, y = clouds.pair(cases.PAPER)
    source, target = (PointCloud(c.astype(np.float64)) for c in (x, y))
    for name, options in peers.installed():
        if not clock.has(10, f"peers: {name}"):
            continue
        register = baseline(name)
        yield _print(
            measure(
                roof,
                lambda register=register, options=options: register(source, target, **options),
                group="peers",
                name=name,
                points=cases.PAPER,
                runs=args.runs,
                limit=20,
            )
        )
    prepared = cases.prepared(cases.PAPER)
    rows = [np.hstack([c.points, c.normals]).astype(np.float32)[None] for c in prepared]
    for checkout in args.authors:
        with tempfile.TemporaryDirectory() as folder:
            found = peers.authors(checkout, *rows, Path(folder))
        if "failure" in found:
            clock.left_out.append(f"{found['name']}: {found['failure']}")
            continue
        times = found["milliseconds"]
        median, fastest = float(np.median(times)), min(times)
        yield _print(
            Line(
                "peers", found["name"], cases.PAPER, 1, len(times), median, fastest, 0.0, None,
                roof.measure(), None, {"threads": found["threads"]},
            )
        )  # fmt: skip


def _print(line: Line) -> Line:
    share = "" if line.share is None else f"{line.share:5.0%} of the roof"
    print(
        f"{line.group:<14} {line.name:<36} {line.points:>6} x{line.batch:<3} "
        f"{line.milliseconds:>9.2f} ms ({line.runs:>2} runs, fastest {line.fastest:.2f}, "
        f"compiled in {line.compile_seconds:.1f} s, roof {line.roof:.0f} GFLOP/s) {share}",
        flush=True,
    )
    return line


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer sizes and batches")
    parser.add_argument("--long", action="store_true", help="also 30,000 and 100,000 points")
    parser.add_argument("--minutes", type=float, default=60.0, help="start no case after this time")
    parser.add_argument("--runs", type=int, default=9, help="runs per case, for the median")
    parser.add_argument(
        "--authors", type=Path, action="append", default=[], metavar="CHECKOUT",
        help="a checkout of the authors' CFR or RPM-Net in PyTorch; may be given twice",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, default=HERE / "results")
    parser.add_argument("--images", type=Path, default=HERE.parent / "docs" / "images")
    return parser.parse_args()


if __name__ == "__main__":
    print(f"cfr_jax {cfr.__version__} on {jax.devices()[0].device_kind}")
    main()
