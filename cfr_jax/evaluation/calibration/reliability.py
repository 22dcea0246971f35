"""How well probabilities hold: calibration, ranking, and a figure of both."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

_BINS = 10
_RESAMPLED = 1000


def calibration_error(chance: np.ndarray, right: np.ndarray, bins: int = _BINS) -> float:
    """Expected calibration error over bins of equal width."""
    return float(sum(abs(said - was) * share for said, was, share in _bins(chance, right, bins)))


def ranking(chance: np.ndarray, right: np.ndarray) -> float:
    """Area under the ROC curve: how often a right answer gets more confidence than a wrong one."""
    above = chance[right][:, None] - chance[~right][None, :]
    return float(np.mean(above > 0) + np.mean(above == 0) / 2)


def summary(chance: np.ndarray, right: np.ndarray) -> dict[str, Any]:
    """Calibration error, ROC area with its 95% interval (pairs resampled), and the effect of
    trusting answers from 0.5 on."""
    rng = np.random.default_rng(0)
    areas = []
    for _ in range(_RESAMPLED):
        rows = rng.integers(len(right), size=len(right))
        if 0 < right[rows].sum() < len(rows):
            areas.append(ranking(chance[rows], right[rows]))
    # what perfectly calibrated probabilities would show by chance, on this number of pairs
    perfect = [calibration_error(chance, rng.random(len(chance)) < chance) for _ in range(200)]
    trusted = chance >= 0.5
    return {
        "pairs": len(right),
        "right": round(float(right.mean()), 3),
        "calibration_error": round(calibration_error(chance, right), 3),
        "calibration_error_by_chance": round(float(np.mean(perfect)), 3),
        "roc_area": round(ranking(chance, right), 3),
        "roc_area_95": [round(float(v), 3) for v in np.quantile(areas, [0.025, 0.975])],
        "trusted": round(float(trusted.mean()), 3),
        "right_of_trusted": _share(right[trusted]),
        "right_of_untrusted": _share(right[~trusted]),
    }


def in_words(measured: dict[str, Any]) -> str:
    """A `summary` on one line."""
    low, high = measured["roc_area_95"]
    return (
        f"right {measured['right']:.0%} of {measured['pairs']}, "
        f"of those trusted {measured['right_of_trusted']:.0%}, "
        f"of the others {measured['right_of_untrusted']:.0%}; "
        f"{measured['calibration_error']:.3f} off "
        f"({measured['calibration_error_by_chance']:.3f} by chance alone), "
        f"ROC area {measured['roc_area']:.3f} ({low:.3f} to {high:.3f})"
    )


def draw(path: Path, curves: dict[str, tuple[np.ndarray, np.ndarray]]) -> None:
    """Draws the reliability diagram and the rejection curve.

    The rejection curve shows, when the least certain answers are dropped, which share of the kept
    ones is wrong.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4), layout="constrained")
    reliable, rejecting = figure.subplots(1, 2)
    for label, (chance, right) in curves.items():
        said, was, share = np.array(list(_bins(chance, right, _BINS))).T
        error, area = calibration_error(chance, right), ranking(chance, right)
        reliable.plot(said, was, alpha=0.6, lw=1)
        reliable.scatter(
            said, was, s=20 + 600 * share, alpha=0.6, label=f"{label}, {error:.3f} off"
        )
        kept = np.arange(1, len(right) + 1)
        wrong = np.cumsum(~right[np.argsort(-chance)]) / kept
        rejecting.plot(kept / len(right), wrong, label=f"{label}, ROC area {area:.3f}")
    reliable.plot([0, 1], [0, 1], color="gray", lw=1, ls="--")
    reliable.set(xlabel="confidence", ylabel="share that was right", title="Reliability")
    rejecting.set(
        xlabel="share of the answers kept, most confident first",
        ylabel="share of those that is wrong",
        title="Rejection",
        xlim=(0, 1),
    )
    for axes in (reliable, rejecting):
        axes.legend(frameon=False, loc="upper left")
        axes.grid(alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def _share(right: np.ndarray) -> float:
    return round(float(right.mean()), 3) if len(right) else 0.0


def _bins(chance: np.ndarray, right: np.ndarray, bins: int) -> Iterator[tuple[float, float, float]]:
    """For each bin that is not empty: mean confidence, share right, and share of all pairs."""
    place = np.minimum((chance * bins).astype(int), bins - 1)
    for b in range(bins):
        here = place == b
        if here.any():
            yield chance[here].mean(), right[here].mean(), here.mean()
