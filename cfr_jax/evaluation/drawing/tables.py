"""The table in Markdown. What depends on machine and day is in a section apart from the errors."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cfr_jax.evaluation import metrics
from cfr_jax.evaluation.measuring import Measured, Statistic
from cfr_jax.evaluation.metrics import Summary

Numbers = Mapping[str, Statistic | None]
_NONE = "–"


def write_table(
    measured: Sequence[Measured],
    numbers: Mapping[str, Numbers],
    about: Mapping[str, Any],
    missing: Mapping[str, str],
    apart: Sequence[Measured] = (),
    numbers_apart: Mapping[str, Numbers] | None = None,
) -> str:
    """The whole text: errors, their intervals, times, failures, settings.

    `about` describes the data and the machine; `missing` says why a method was left out. `apart`
    and `numbers_apart` are like `measured` and `numbers`, without the pairs of nearly symmetric
    shapes. The same answers give the same text, except for the section `Time`.
    """
    unit = about["unit"]
    lengths = unit or "the unit of the clouds"
    columns = _columns(measured, about["thresholds"], unit)
    lines = [
        f"# {about['title']}",
        "",
        f"{about['pairs']} pairs of `{about['data']}`, seed {about['seed']}. RE in degrees, TE in "
        f"{lengths}. Errors are over the pairs that a method answered; recall is over all pairs, "
        "and a failure is a miss.",
        "",
        *_errors(measured, numbers, columns),
        "",
        *_apart(apart, numbers_apart or {}, columns, about),
        "## Settings",
        "",
        *(f"- **{m.name}**: {_settings(m.about)}" for m in measured),
        *(f"- **{name}**: not run, {reason}" for name, reason in missing.items()),
        "",
        *_failures(measured),
        "## Time",
        "",
        f"{about['machine']}; table made on {about['date']} with commit {about['commit']}; the "
        "last column has the commits of the answers. The time is the median over the pairs, from "
        "clouds in host memory to the motion in host memory, device-synchronized, including "
        "neighbors, normals and features. Imports, compilation and other costs of the first call "
        "are in the start-up column. "
        f"Versions: {', '.join(f'{k} {v}' for k, v in about['versions'].items())}.",
        "",
        *_grid(
            ["method", "ms / pair", "start-up s", "threads", "device", "pairs / call", "commit"],
            [_times(m) for m in measured],
        ),
        "",
        *_modules(measured),
        f"    {about['command']}",
        "",
    ]
    return "\n".join(lines)


def _errors(
    measured: Sequence[Measured],
    numbers: Mapping[str, Numbers],
    columns: Sequence[Summary],
) -> list[str]:
    """A table with a row for each method, and a second one with the intervals."""
    header = ["method", *(str(column.title) for column in columns)]
    values, intervals = (
        [
            [m.name, *(tell(numbers[m.name][c.name], c.scale, c.form) for c in columns)]
            for m in measured
        ]
        for tell in (_value, _interval)
    )
    failed = [_failed(m) for m in measured]
    return [
        *_grid([*header, "failed"], [[*row, n] for row, n in zip(values, failed, strict=True)]),
        "",
        "95 % intervals (bootstrap over pairs):",
        "",
        *_grid(header, intervals),
    ]


def _failed(m: Measured) -> str:
    """How many failed; why, where it was all of them, for one reason."""
    reasons = set(m.failures.values())
    if len(reasons) == 1 and not m.answered.any():
        return f"{len(m.failures)}: {reasons.pop()}"
    return str(len(m.failures))


def _apart(
    measured: Sequence[Measured],
    numbers: Mapping[str, Numbers],
    columns: Sequence[Summary],
    about: Mapping[str, Any],
) -> list[str]:
    if not measured:
        return []
    return [
        "## Without nearly symmetric shapes",
        "",
        f"{about['nearly_symmetric']} of the pairs show shapes that fit on themselves after some "
        "rotation, about as closely as sampling can tell (`cfr_jax/evaluation/symmetry.py`, a "
        "rule on the shape alone). These are the others:",
        "",
        *_errors(measured, numbers, columns),
        "",
    ]


def _modules(measured: Sequence[Measured]) -> list[str]:
    """A table of the milliseconds of each part of a network, if any were timed."""
    timed = {m.name: m.modules for m in measured if m.modules}
    if not timed:
        return []
    parts = list(dict.fromkeys(part for seconds in timed.values() for part in seconds))
    rows = [
        [
            name,
            *(f"{seconds[part] * 1e3:.2f}" if part in seconds else _NONE for part in parts),
            f"{sum(seconds.values()) * 1e3:.1f}",
        ]
        for name, seconds in timed.items()
    ]
    return [
        "Milliseconds per pair by module, each compiled alone, device-synchronized, on the threads "
        "above; medians over a few pairs:",
        "",
        *_grid(["method", *parts, "sum"], rows),
        "",
    ]


def _columns(
    measured: Sequence[Measured], thresholds: Sequence[Sequence[float]], unit: str
) -> list[Summary]:
    """The columns: summaries of every metric that was measured, and the recalls."""
    known = [
        metric for metric in metrics.entries() if any(metric.name in m.errors for m in measured)
    ]
    summaries = [summary for metric in known for summary in metric.summaries if summary.title]
    return summaries + [metrics.recall(angle, distance, unit) for angle, distance in thresholds]


def _value(number: Statistic | None, scale: float, form: str) -> str:
    return _NONE if number is None else format(number.value * scale, form)


def _interval(number: Statistic | None, scale: float, form: str) -> str:
    if number is None:
        return _NONE
    return f"{number.low * scale:{form}} to {number.high * scale:{form}}"


def _settings(about: Mapping[str, Any]) -> str:
    told = [about["use"]]
    told += [f"{key} {json.dumps(value)}" for key, value in about["options"].items()]
    if about["estimated_normals"]:
        told.append("normals estimated from the points")
    if "weights" in about:
        told.append(f"weights {about['weights']} ({about['sha256'][:12]})")
    return ", ".join(told)


def _failures(measured: Sequence[Measured]) -> list[str]:
    failing = [m for m in measured if m.failures]
    if not failing:
        return []
    lines = ["## Failures", ""]
    for m in failing:
        reasons: dict[str, list[int]] = {}
        for index, reason in m.failures.items():
            reasons.setdefault(reason, []).append(index)
        for reason, rows in reasons.items():
            shown = ", ".join(map(str, rows[:10])) + (", …" if len(rows) > 10 else "")
            lines.append(f"- **{m.name}**, {len(rows)} pairs ({shown}): {reason}")
    return [*lines, ""]


def _times(m: Measured) -> list[str]:
    started = m.started or {}
    time = m.milliseconds()
    return [
        m.name,
        _NONE if np.isnan(time) else f"{time:.1f}",
        f"{started['seconds']:.1f}" if started else _NONE,
        str(started.get("threads", _NONE)),
        str(started.get("device", _NONE)),
        str(m.about["batch"]),
        str(started.get("commit", _NONE)),
    ]


def _grid(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    ruler = ["---"] + ["---:"] * (len(header) - 1)
    return ["| " + " | ".join(cells) + " |" for cells in (header, ruler, *rows)]
