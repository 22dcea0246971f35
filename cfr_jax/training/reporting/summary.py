"""`summary.html`: the results of a training, on one self-contained page."""

from __future__ import annotations

import html
import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cfr_jax.runtime.atomic import write_atomically
from cfr_jax.training.reporting.charts import Chart, charts

_WIDTH, _HEIGHT, _LEFT, _BELOW, _ABOVE = 460, 220, 52, 28, 14
_COLORS = ("#0a6ebd", "#d9822b", "#2e8b57", "#8e44ad", "#7f8c8d")
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1b2029; max-width: 62rem;
  margin: 2rem auto; padding: 0 1rem; }
figure { display: inline-block; margin: 0 1rem 1.5rem 0; vertical-align: top; }
figcaption { font-weight: 600; } svg { background: #fafbfc; border: 1px solid #e3e6ea; }
td, th { text-align: left; padding: .15rem 1.2rem .15rem 0; font-variant-numeric: tabular-nums; }
pre { background: #fafbfc; border: 1px solid #e3e6ea; padding: .6rem; overflow-x: auto; }
"""


def write_summary(path: Path, lines: Sequence[dict[str, Any]], about: dict[str, Any]) -> None:
    """Writes a page with the curves of a journal's `lines`, and the best validation, the time and
    the config in `about` (what a checkpoint says about itself)."""
    body = "".join(_figure(chart) for chart in charts(lines))
    best = about["best"]
    rows = {
        "trained on": about["data"]["data.train"],
        "validated on": about["data"]["data.validation"],
        "best validation": f"step {best['step']}" if best else "none",
        "rotation error, mean": _number(best.get("rotation_mean"), "°"),
        "rotation error, median": _number(best.get("rotation_median"), "°"),
        "translation error, mean": _number(best.get("translation_mean"), ""),
        "recall (5°, 0.1)": _number(best.get("recall_5deg_0.1"), ""),
        "steps": str(about["step"]),
        "steps skipped": str(about["skipped"]),
        "pairs seen": str(about["position"]),
        "training": f"{about['clock']['seconds'] / 3600:.2f} h without validations",
        "processor time": f"{about['clock']['processor_seconds'] / 3600:.2f} h",
        "versions": ", ".join(f"{name} {text}" for name, text in about["versions"].items()),
    }
    table = "".join(
        f"<tr><th>{html.escape(name)}</th><td>{html.escape(text)}</td></tr>"
        for name, text in rows.items()
    )
    config = html.escape(json.dumps(about["config"], indent=2))
    page = (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>Training</title>'
        f"<style>{_STYLE}</style><h1>Training</h1><table>{table}</table><h2>Curves</h2>{body}"
        f"<h2>Config</h2><pre>{config}</pre></html>\n"
    )
    write_atomically(path, page.encode())


def _figure(chart: Chart) -> str:
    steps = [step for curve in chart.curves for step in curve.steps]
    values = [value for curve in chart.curves for value in curve.values if _finite(value)]
    low, high = (min(values), max(values)) if values else (0.0, 1.0)
    if low == high:
        low, high = low - 0.5, high + 0.5
    first, last = min(steps), max(max(steps), min(steps) + 1)

    def place(step: int, value: float) -> str:
        x = _LEFT + (step - first) / (last - first) * (_WIDTH - _LEFT - 10)
        y = _ABOVE + (high - value) / (high - low) * (_HEIGHT - _ABOVE - _BELOW)
        return f"{x:.1f},{y:.1f}"

    drawn, legend = [], []
    for curve, color in zip(chart.curves, itertools.cycle(_COLORS), strict=False):
        points = " ".join(
            place(step, value)
            for step, value in zip(curve.steps, curve.values, strict=True)
            if _finite(value)
        )
        drawn.append(f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="2"/>')
        if len(chart.curves) > 1:
            legend.append(f'<span style="color:{color}">{html.escape(curve.name)}</span>')
    labels = "".join(
        f'<text x="{x}" y="{y}" font-size="11" text-anchor="{anchor}" fill="#5a6472">{text}</text>'
        for x, y, anchor, text in (
            (_LEFT - 6, _ABOVE + 9, "end", f"{high:.3g}"),
            (_LEFT - 6, _HEIGHT - _BELOW, "end", f"{low:.3g}"),
            (_LEFT, _HEIGHT - 8, "start", f"step {first}"),
            (_WIDTH - 10, _HEIGHT - 8, "end", f"{last}"),
        )
    )
    caption = html.escape(f"{chart.title} ({chart.unit})" if chart.unit else chart.title)
    return (
        f'<figure><figcaption>{caption}</figcaption><svg width="{_WIDTH}" height="{_HEIGHT}" '
        f'role="img" aria-label="{caption}">{"".join(drawn)}{labels}</svg>'
        f"<div>{' · '.join(legend)}</div></figure>"
    )


def _finite(value: float) -> bool:
    return value == value and abs(value) != float("inf")


def _number(value: float | None, unit: str) -> str:
    return "–" if value is None else f"{value:.3g}{unit}"
