"""Runs ways to merge on sets of scans, and writes the table."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from cfr_jax.evaluation import machine
from cfr_jax.evaluation.multiway import ways
from cfr_jax.evaluation.multiway.config import MergeConfig
from cfr_jax.evaluation.multiway.errors import pose_errors, wrong_edges
from cfr_jax.evaluation.multiway.sets import ScanSet, read_sets
from cfr_jax.evaluation.multiway.ways import Placed
from cfr_jax.runtime.atomic import write_atomically
from cfr_jax.weights.files import read_weights


def compare_merges(
    config: MergeConfig, out: Path, names: Sequence[str] = (), command: str = ""
) -> str:
    """Runs the methods called `names` (if empty, all of the config) on all sets.

    `results.json` in `out` holds every set, and `table.md` the returned text. Raises ValueError for
    a config or data that cannot be used, ModuleNotFoundError for a method without its library.
    """
    chosen = tuple(names) or config.methods
    if unknown := [name for name in chosen if name not in config.methods]:
        raise ValueError(f"methods: got {unknown}, wanted some of {', '.join(config.methods)}")
    sets = read_sets(config.data, config.limit)
    params = read_weights(config.weights, "cfr").params
    methods: dict[str, Callable[[ScanSet], Placed]] = {
        "merge": lambda each: ways.merged(
            each.files, params=params, ordered=config.ordered, seed=config.seed
        ),
        "chain": lambda each: ways.chained(each.files, params=params, seed=config.seed),
        "open3d": lambda each: ways.by_open3d(each.files, ordered=config.ordered, seed=config.seed),
    }
    results = {
        name: [measured(methods[name], each, config) for each in tqdm(sets, name, disable=None)]
        for name in chosen
    }
    table = as_table(results, config, command)
    out.mkdir(parents=True, exist_ok=True)
    about = {"title": config.title, "command": command, **machine.stamp()}
    document = json.dumps({"about": about, "methods": results}, indent=1)
    write_atomically(out / "results.json", document.encode())
    write_atomically(out / "table.md", table.encode())
    return table


def measured(
    method: Callable[[ScanSet], Placed], scans: ScanSet, config: MergeConfig
) -> dict[str, Any]:
    """What a method found of one set, against the truth."""
    centers = scans.centers()
    began = time.perf_counter()
    found = method(scans)
    seconds = time.perf_counter() - began
    rows = found.placed
    degrees = lengths = np.zeros(0)
    if len(rows):
        degrees, lengths = pose_errors(found.poses, scans.poses[rows], centers[rows])
    right = (degrees <= config.threshold[0]) & (lengths <= config.threshold[1])
    return {
        "name": scans.name,
        "scans": len(scans.files),
        "placed": len(rows),
        "right": int(right.sum()),
        "degrees": degrees.tolist(),
        "lengths": lengths.tolist(),
        "edges": len(found.edges),
        "wrong_edges": wrong_edges(found, scans.poses, centers, config.wrong_edge),
        "seconds": seconds,
    }


def as_table(results: dict[str, list[dict[str, Any]]], config: MergeConfig, command: str) -> str:
    """A row for each method."""
    degrees, length = config.threshold
    unit = config.unit or "radii"
    stamp = machine.stamp()
    lines = [
        f"# {config.title}",
        "",
        f"Poses after the best common motion onto the truth. Right: within {degrees:g} degrees and "
        f"{length:g} {unit}; errors are medians over the placed scans; an edge is wrong beyond "
        f"{config.wrong_edge[0]:g} degrees or {config.wrong_edge[1]:g} {unit}.",
        "",
        "| method | scans | right | placed wrong | left out | RE | TE | edges | wrong edges "
        "| s / scan |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, sets in results.items():
        total, placed, right, edges, wrong = (
            sum(each[key] for each in sets)
            for key in ("scans", "placed", "right", "edges", "wrong_edges")
        )
        errors = [
            np.concatenate([each[key] for each in sets]) if placed else np.zeros(0)
            for key in ("degrees", "lengths")
        ]
        angle, away = (f"{np.median(each):.3g}" if len(each) else "–" for each in errors)
        seconds = sum(each["seconds"] for each in sets) / total
        lines.append(
            f"| {name} | {total} | {right} ({right / total:.0%}) | {placed - right} "
            f"| {total - placed} | {angle} | {away} | {edges} | {wrong} | {seconds:.2f} |"
        )
    lines += ["", f"{stamp['machine']}; made on {stamp['date']} with commit {stamp['commit']}.", ""]
    lines += [f"    {command}", ""]
    return "\n".join(lines)
