"""The table in Markdown. What depends on the machine and the day stands apart from the errors."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cfr_jax.evaluation.measuring import Measured, recall_name
from cfr_jax.metrics import Statistic

Numbers = Mapping[str, Statistic | None]
_NONE = "–"


def write_table(
    measured: Sequence[Measured],
    numbers: Mapping[str, Numbers],
    about: Mapping[str, Any],
    missing: Mapping[str, str],
) -> str:
    """All of it: errors, their intervals, times, failures, settings.

    `about` is what `running` knows of data and machine; `missing` tells why a method was left out.
    Same answers, same text, but for the section `Time`.
    """
    unit = about["unit"]
    lengths = unit or "the unit of the clouds"
    columns = _columns(about["thresholds"], unit, any(m.chamfer is not None for m in measured))
    rows = [
        [m.name] + [_value(numbers[m.name][key], scale, form) for _, key, scale, form in columns]
        for m in measured
    ]
    intervals = [
        [m.name] + [_interval(numbers[m.name][key], scale, form) for _, key, scale, form in columns]
        for m in measured
    ]
    header = ["method", *(title for title, *_ in columns)]
    lines = [
        f"# {about['title']}",
        "",
        f"{about['pairs']} pairs of `{about['data']}`, seed {about['seed']}. RE in degrees, TE in "
        f"{lengths}. Errors are over the pairs that a method answered; recall is over all pairs, "
        "and a failure is a miss.",
        "",
        *_grid([*header, "failed"], [[*r, str(len(m.failures))] for r, m in _with(rows, measured)]),
        "",
        "95 % intervals (bootstrap over pairs):",
        "",
        *_grid(header, intervals),
        "",
        "## Settings",
        "",
        *(f"- **{m.name}**: {_settings(m.about)}" for m in measured),
        *(f"- **{name}**: not run, {reason}" for name, reason in missing.items()),
        "",
        *_failures(measured),
        "## Time",
        "",
        f"{about['machine']}; commit {about['commit']}, {about['date']}. Median of the pairs: from "
        "clouds in host memory to the motion in host memory, device-synchronized, neighbors, "
        "normals and features included. Imports, compilation and first-call costs are apart. "
        f"Versions: {', '.join(f'{k} {v}' for k, v in about['versions'].items())}.",
        "",
        *_grid(
            ["method", "ms / pair", "start-up s", "threads", "device", "pairs a call"],
            [_times(m) for m in measured],
        ),
        "",
        f"    {about['command']}",
        "",
    ]
    return "\n".join(lines)


def _columns(
    thresholds: Sequence[tuple[float, float]], unit: str, chamfer: bool
) -> list[tuple[str, str, float, str]]:
    """Title, key, scale, format."""
    columns = [
        ("RE mean", "err_r_mean", 1.0, ".2f"),
        ("RE median", "err_r_median", 1.0, ".2f"),
        ("TE mean", "err_t_mean", 1.0, ".4f"),
        ("TE median", "err_t_median", 1.0, ".4f"),
    ]
    if chamfer:
        columns += [
            ("CD mean ×1000", "chamfer_mean", 1e3, ".3f"),
            ("CD median ×1000", "chamfer_median", 1e3, ".3f"),
        ]
    for angle, distance in thresholds:
        title = f"recall {angle:g}°, {distance:g}{' ' + unit if unit else ''}"
        columns.append((title, recall_name(angle, distance), 1.0, ".3f"))
    return columns


def _value(number: Statistic | None, scale: float, form: str) -> str:
    return _NONE if number is None else format(number.value * scale, form)


def _interval(number: Statistic | None, scale: float, form: str) -> str:
    if number is None:
        return _NONE
    return f"{number.low * scale:{form}} to {number.high * scale:{form}}"


def _with(rows: list[list[str]], measured: Sequence[Measured]) -> list[tuple[list[str], Measured]]:
    return list(zip(rows, measured, strict=True))


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
    ]


def _grid(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    ruler = ["---"] + ["---:"] * (len(header) - 1)
    return ["| " + " | ".join(cells) + " |" for cells in (header, ruler, *rows)]
