"""Turns the result file into tables and graphs: python benchmarks/report.py results/speed.json"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cost
import numpy as np


def write(told: dict, out: Path, images: Path) -> None:
    """Writes `speed.md` into `out` and, if matplotlib is installed, the graphs into `images`."""
    (out / "speed.md").write_text(tables(told), encoding="utf-8")
    try:
        import matplotlib
    except ImportError:
        print('no graphs: they need matplotlib (pip install "cfr_jax[viz]")', file=sys.stderr)
        return
    matplotlib.use("Agg")
    images.mkdir(parents=True, exist_ok=True)
    _draw_sizes(told, images / "speed_sizes.png")
    _draw_modules(told, images / "speed_modules.png")


def tables(told: dict) -> str:
    """All tables as Markdown, with ratios first."""
    lines = told["lines"]
    whole = [line for line in lines if line["group"] == "whole pair"]
    first = whole[0] if whole else None
    roofs = [line["roof"] for line in lines]
    parts = [
        "# Measured\n",
        "Made by `make bench` (`benchmarks/run.py`); do not edit. "
        f"{told['machine']}; commit {told['commit']}; "
        + ", ".join(f"{k} {v}" for k, v in told["versions"].items())
        + f". Roof: a float32 product of 2,048 x 2,048, {np.median(roofs):.0f} GFLOP/s "
        f"({min(roofs):.0f} to {max(roofs):.0f} over the run).\n",
    ]
    if first:
        budget = 30 * 440 / first["roof"]
        parts.append(
            f"A pair of 717 points takes {first['milliseconds']:.1f} ms, "
            f"{first['milliseconds'] / budget:.2f} of the budget of 30 ms x 440 / roof "
            f"({budget:.1f} ms), at {first['share']:.0%} of the roof.\n"
        )
    parts += _group("Whole pairs", whole, first, "time / 717 points")
    for title, group, base, ratio in (
        ("Modules, both clouds", "modules", first, "share of a pair"),
        ("Speed-ups off, network alone", "speed-ups off", None, "time / as it is"),
        ("Peers", "peers", first, "time / ours"),
    ):
        chosen = [line for line in lines if line["group"] == group]
        parts += _group(title, chosen, base or (chosen[0] if chosen else None), ratio)
    chosen = [line for line in lines if line["group"] == "batches"]
    parts += _batches(chosen)
    if told.get("start_up"):
        start = told["start_up"]
        parts.append(
            f"## Start-up\n\n`cfr register` of one pair, its programs cached: {start['ratio']:.2f} "
            f"times importing JAX and adding three numbers ({start['second']:.2f} s and "
            f"{start['jax']:.2f} s, medians of {start['runs']}; the first call of all took "
            f"{start['first']:.1f} s).\n"
        )
    if told.get("memory"):
        parts.append(
            "## Peak memory\n\nOf a fresh process, MiB, and what the cost model says of the arrays."
            "\n\n| points | peak | without the imports | model |\n|---|---|---|---|"
        )
        for m in told["memory"]:
            streamed = m["points"] ** 2 > 1 << 25
            model = cost.memory(m["points"], m["points"], streamed=streamed) / 2**20
            own = m["peak"] - m["imports"]
            parts.append(f"| {m['points']:,} | {m['peak']:.0f} | {own:.0f} | {model:.0f} |")
        parts.append("")
    parts.append(
        "![Time against points](../../docs/images/speed_sizes.png)\n\n"
        "![Where the time of a pair goes](../../docs/images/speed_modules.png)\n"
    )
    if told["left_out"]:
        parts.append(
            "Left out, for time or because it failed: " + "; ".join(told["left_out"]) + ".\n"
        )
    return "\n".join(parts)


def _group(title, lines, base, ratio):
    if not lines:
        return []
    rows = [
        f"## {title}\n",
        f"| what | points | {ratio} | roof | ms | fastest | runs | compile s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for line in lines:
        share = "" if line["share"] is None else f"{line['share']:.0%}"
        over = line["milliseconds"] / base["milliseconds"]
        rows.append(
            f"| {line['name']} | {line['points']:,} | {over:.2f} | {share} "
            f"| {line['milliseconds']:.1f} | {line['fastest']:.1f} | {line['runs']} "
            f"| {line['compile_seconds']:.1f} |"
        )
    return [*rows, ""]


def _batches(lines):
    if not lines:
        return []
    rows = [
        "## Batches, network alone\n",
        "| batch | pairs per second / batch 1 | roof | ms per pair | runs |",
        "|---|---|---|---|---|",
    ]
    one = lines[0]["milliseconds"]
    for line in lines:
        each = line["milliseconds"] / line["batch"]
        rows.append(
            f"| {line['batch']} | {one / each:.2f} | {line['share']:.0%} | {each:.1f} "
            f"| {line['runs']} |"
        )
    return [*rows, ""]


def _draw_sizes(told, path):
    """Plots time against points, and the cost model's prediction at the share of 717 points."""
    import matplotlib.pyplot as plt

    whole = [line for line in told["lines"] if line["group"] == "whole pair"]
    if not whole:
        return
    counts = np.array([line["points"] for line in whole])
    grid = np.geomspace(counts.min(), max(counts.max(), 12000), 50)
    reach = whole[0]["share"] * whole[0]["roof"] * 1e9
    parts = {
        "features": lambda n: 2 * cost.features(n),
        "match": lambda n: cost.match(n, n, streamed=n * n > 1 << 25),
        "whole pair": lambda n: (
            cost.pair(n, n) - cost.match(n, n) + cost.match(n, n, streamed=n * n > 1 << 25)
        ),
    }
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    for name, model in parts.items():
        seconds = [model(n) / reach for n in grid]
        axes.loglog(grid, seconds, "--", label=f"{name}, model", alpha=0.8)
    axes.loglog(counts, [line["milliseconds"] / 1e3 for line in whole], "o", label="measured")
    axes.set(xlabel="points of each cloud", ylabel="seconds")
    axes.legend()
    figure.savefig(path, dpi=120)
    plt.close(figure)


def _draw_modules(told, path):
    """Plots the time of each part of a pair, and its share of the roof."""
    import matplotlib.pyplot as plt

    skip = ("bfloat16", "by ", "on the device")
    chosen = [
        line
        for line in told["lines"]
        if line["group"] == "modules" and not any(word in line["name"] for word in skip)
    ]
    if not chosen:
        return
    names = [line["name"] for line in chosen]
    figure, axes = plt.subplots(figsize=(6, 3.2), layout="constrained")
    bars = axes.barh(names, [line["milliseconds"] for line in chosen])
    labels = ["" if line["share"] is None else f"{line['share']:.0%} of roof" for line in chosen]
    axes.bar_label(bars, labels, padding=3)
    axes.margins(x=0.3)
    axes.invert_yaxis()
    axes.set(xlabel="milliseconds of a pair of 717 points")
    figure.savefig(path, dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    result = Path(sys.argv[1])
    images = Path(__file__).parents[1] / "docs" / "images"
    write(json.loads(result.read_text("utf-8")), result.parent, images)
