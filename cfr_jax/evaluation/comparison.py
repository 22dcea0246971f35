"""Runs all methods of a configuration on its pairs, and writes the results."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool
from tqdm import tqdm

from cfr_jax.data.pairs import Pair
from cfr_jax.evaluation import machine, metrics
from cfr_jax.evaluation.config import EvaluationConfig, checked
from cfr_jax.evaluation.datasets import read_pairs
from cfr_jax.evaluation.drawing.tables import Numbers, write_table
from cfr_jax.evaluation.measuring import Measured, measure, only, summarize
from cfr_jax.evaluation.methods import methods_of
from cfr_jax.evaluation.running import run_method
from cfr_jax.evaluation.store import Records
from cfr_jax.evaluation.symmetry import nearly_symmetric
from cfr_jax.runtime.atomic import write_atomically


class Comparison(NamedTuple):
    """What `compare` tells, besides the files it writes."""

    table: str
    unanswered: dict[str, str]
    """The methods that ran and answered no pair, with the reason for the first one."""


def compare(
    config: EvaluationConfig,
    out: Path,
    names: Sequence[str] = (),
    plots: bool = True,
    command: str = "",
) -> Comparison:
    """Runs the methods called `names` (if empty, all of the config), and writes into `out`.

    `results.json` holds every pair with every iteration, and `table.md` the returned table; plots
    and galleries are beside them. `parts/` keeps the answers of each method, so the same call
    resumes where it stopped, and other methods or more pairs can be added later. Raises ValueError
    for a config or data that cannot be used.
    """
    config = checked(config)
    methods = methods_of(config, names, config.seed)
    if plots:
        from cfr_jax.evaluation.drawing.figures import draw_all, new_figure
        from cfr_jax.evaluation.drawing.gallery import draw_gallery

        new_figure(1, 1)  # if matplotlib is missing, fail now and not after all methods have run
    pairs = read_pairs(config.data, config.limit, out / "cache")
    held = {
        m.name: run_method(m, pairs, out / "parts" / f"{m.name}.json", config.timeout)
        for m in methods
    }
    run = {name: each for name, each in held.items() if each.missing is None}
    missing = {name: each.missing for name, each in held.items() if each.missing is not None}
    measured = [
        measure(name, each, pairs) for name, each in tqdm(run.items(), "measuring", disable=None)
    ]
    numbers = _summaries(measured, config)
    about = _about(config, len(pairs), command)
    symmetric = nearly_symmetric(pairs, out / "cache" / "symmetries.json")
    apart: list[Measured] = []
    if symmetric is not None and 0 < symmetric.sum() < len(pairs):
        apart = [only(m, np.flatnonzero(~symmetric)) for m in measured]
    numbers_apart = _summaries(apart, config)
    about["nearly_symmetric"] = None if symmetric is None else int(symmetric.sum())
    table = write_table(measured, numbers, about, missing, apart, numbers_apart)
    results = {
        "about": about,
        "missing": missing,
        "methods": {
            m.name: {
                "settings": m.about,
                "started": m.started,
                "milliseconds": _number(m.milliseconds()),
                "seconds_by_module": m.modules,
                "numbers": _as_json(numbers[m.name]),
                "numbers_without_symmetric": _as_json(numbers_apart.get(m.name, {})),
                "pairs": _of_pairs(m, run[m.name], pairs, symmetric),
            }
            for m in measured
        },
    }
    write_atomically(out / "results.json", json.dumps(results, indent=1).encode())
    write_atomically(out / "table.md", table.encode())
    if plots:
        draw_all(out / "plots", measured, pairs, about)
        for m in tqdm(measured, "gallery", disable=None):
            draw_gallery(out / "gallery" / f"{m.name}.png", m, run[m.name], pairs)
    unanswered = {
        m.name: next(iter(m.failures.values())) for m in measured if len(m.failures) == len(pairs)
    }
    return Comparison(table, unanswered)


def _summaries(measured: Sequence[Measured], config: EvaluationConfig) -> dict[str, Numbers]:
    return {m.name: summarize(m, config.thresholds, config.seed) for m in measured}


def _as_json(numbers: Numbers) -> dict[str, Any]:
    return {key: number and number._asdict() for key, number in numbers.items()}


def _about(config: EvaluationConfig, count: int, command: str) -> dict[str, Any]:
    return {
        "title": config.title,
        "data": _told(config.data),
        "pairs": count,
        "seed": config.seed,
        "unit": config.unit,
        "thresholds": [list(threshold) for threshold in config.thresholds],
        "main_threshold": list(config.main_threshold),
        "limits": list(config.limits),
        "timeout": config.timeout,
        "command": command,
        **machine.stamp(),
        "versions": machine.versions(),
    }


def _told(data: dict[str, Any]) -> str:
    return " ".join(f"{key}={value}" for key, value in sorted(data.items()))


def _of_pairs(
    m: Measured, held: Records, pairs: Sequence[Pair], symmetric: Bool[np.ndarray, " p"] | None
) -> list[dict[str, Any]]:
    told = []
    for index, pair in enumerate(pairs):
        record = held.by_pair[index]
        told.append(
            {
                "index": index,
                "name": pair.name,
                "overlap": _number(pair.overlap),
                "nearly_symmetric": None if symmetric is None else bool(symmetric[index]),
                "failure": record.failure,
                **_errors_of(m, index),
                "seconds": record.seconds,
                "transforms": record.transforms,
            }
        )
    return told


def _errors_of(m: Measured, index: int) -> dict[str, Any]:
    """The errors of one pair by each metric of the table, per iteration or for the answer."""
    told: dict[str, Any] = {}
    for metric in metrics.entries():
        if not any(summary.title for summary in metric.summaries):
            continue
        errors = m.errors.get(metric.name)
        numbers = [None] if errors is None else [_number(value) for value in errors[index]]
        told[metric.name] = numbers if metric.each_iteration else numbers[-1]
    return told


def _number(value: float | None) -> float | None:
    """The value as JSON, which has no NaN: None if it is not finite."""
    return None if value is None or not np.isfinite(value) else float(value)
