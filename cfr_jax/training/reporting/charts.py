"""The charts of a training: the page and TensorBoard both draw the numbers named here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

_TRAINING = ("loss", "pose", "correspondence", "learning_rate", "steps_per_second", "skipped")
_ITERATIONS = ("rotation_error", "translation_error", "beta", "alpha")
_VALIDATION = ("rotation_mean", "rotation_median", "translation_mean", "recall_5deg_0.1")


@dataclass(frozen=True)
class Curve:
    """One number over the steps."""

    name: str
    steps: Sequence[int]
    values: Sequence[float]


@dataclass(frozen=True)
class Chart:
    """Curves that belong together, in one unit."""

    title: str
    unit: str
    curves: Sequence[Curve]


def scalars(line: dict[str, Any]) -> dict[str, float]:
    """The numbers in a line of the journal by tag, such as "training/loss".

    Values per iteration are numbered from 1: "training/beta/1".
    """
    validation = line.get("validation", {})
    found = {f"training/{name}": line[name] for name in _TRAINING if name in line}
    for name in _ITERATIONS:
        found |= _numbered(f"training/{name}", line.get(name, ()))
    found |= {f"validation/{name}": validation[name] for name in _VALIDATION if name in validation}
    return found | _numbered("validation/rotation", validation.get("rotation_by_iteration", ()))


def charts(lines: Sequence[dict[str, Any]]) -> list[Chart]:
    """The charts of a whole journal; charts without any measurement are left out."""
    measured = [(line["step"], scalars(line)) for line in lines]
    tags = {tag for _, found in measured for tag in found}
    count = sum(tag.startswith("training/beta/") for tag in tags)
    each = range(1, count + 1)
    planned = [
        (
            "Loss",
            "",
            {
                "all": "training/loss",
                "motion and slack": "training/pose",
                "correspondences, before their weight": "training/correspondence",
            },
        ),
        (
            "Rotation error",
            "degrees",
            {
                "training": f"training/rotation_error/{count}",
                "validation, mean": "validation/rotation_mean",
                "validation, median": "validation/rotation_median",
            },
        ),
        (
            "Translation error",
            "radii",
            {
                "training": f"training/translation_error/{count}",
                "validation": "validation/translation_mean",
            },
        ),
        ("Recall at 5° and 0.1", "", {"validation": "validation/recall_5deg_0.1"}),
        ("Learning rate", "", {"rate": "training/learning_rate"}),
        ("Speed", "steps/s", {"speed": "training/steps_per_second"}),
        (
            "beta: how sharply affinities fall with the distance of the features",
            "",
            {f"iteration {i}": f"training/beta/{i}" for i in each},
        ),
        (
            "alpha: the squared distance up to which points match",
            "",
            {f"iteration {i}": f"training/alpha/{i}" for i in each},
        ),
    ]
    return [
        Chart(title, unit, [_curve(name, tag, measured) for name, tag in wanted.items()])
        for title, unit, wanted in planned
        if tags & set(wanted.values())
    ]


def _numbered(tag: str, values: Sequence[float]) -> dict[str, float]:
    return {f"{tag}/{i}": value for i, value in enumerate(values, start=1)}


def _curve(name: str, tag: str, measured: Sequence[tuple[int, dict[str, float]]]) -> Curve:
    known = [(step, found[tag]) for step, found in measured if tag in found]
    return Curve(name, [step for step, _ in known], [value for _, value in known])
