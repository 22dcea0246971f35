"""From answers to errors, and from errors to the numbers of a table."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from cfr_jax.data.pairs import Pair
from cfr_jax.evaluation import metrics
from cfr_jax.evaluation.metrics import Statistic
from cfr_jax.evaluation.store import Records
from cfr_jax.geometry.motions import nearest_motion

# Root mean square and mean absolute differences of Euler angles and of coordinates.
_BY_AXIS = ("r_mae", "r_rmse", "t_mae", "t_rmse")


@dataclass(frozen=True, eq=False)
class Measured:
    """Errors of one method over P pairs: degrees, and the unit of the clouds. NaN where it failed.

    `chamfer` is None where the pairs know no whole shapes.
    """

    name: str
    err_r: Float[np.ndarray, "p i"]
    """After each iteration the method tells of; the last column is the answer."""
    err_t: Float[np.ndarray, "p i"]
    chamfer: Float[np.ndarray, " p"] | None
    by_axis: dict[str, Float[np.ndarray, " p"]]
    """`r_mae`, `r_rmse`, `t_mae` and `t_rmse` of the answer, over the axes of each pair."""
    seconds: Float[np.ndarray, " p"]
    failures: dict[int, str]
    about: dict[str, Any]
    started: dict[str, Any] | None
    modules: dict[str, float] | None = None

    @property
    def answered(self) -> Bool[np.ndarray, " p"]:
        """Where the method gave an answer."""
        return np.isfinite(self.err_r[:, -1])

    def recalled(self, angle: float, distance: float) -> Bool[np.ndarray, " p"]:
        """Which pairs are solved to this accuracy; a failure is not."""
        return metrics.recalled(self.err_r[:, -1], self.err_t[:, -1], angle, distance)

    def milliseconds(self) -> float:
        """Median over the pairs answered; NaN where there are none."""
        known = self.seconds[self.answered]
        return float(np.median(known) * 1e3) if len(known) else np.nan


def measure(name: str, records: Records, pairs: Sequence[Pair]) -> Measured:
    """The errors of what `records` holds of all pairs.

    Estimates are made exactly rigid first, as the truths are: their rounding to float32 would read
    as hundredths of a degree.
    """
    answers = {
        index: nearest_motion(np.array(record.transforms))
        for index, record in records.by_pair.items()
        if record.transforms is not None
    }
    iterations = max((len(answer) for answer in answers.values()), default=1)
    err_r, err_t = np.full((2, len(pairs), iterations), np.nan)
    chamfer, seconds = np.full((2, len(pairs)), np.nan)
    by_axis = {name: np.full(len(pairs), np.nan) for name in _BY_AXIS}
    for index, estimates in answers.items():
        pair, told = pairs[index], records.by_pair[index].seconds
        truths = np.broadcast_to(pair.transform, estimates.shape)
        err_r[index] = metrics.err_r(estimates, truths)
        err_t[index] = metrics.err_t(estimates, truths)
        seconds[index] = np.nan if told is None else told
        for measure_of, errors in by_axis.items():
            errors[index] = getattr(metrics, measure_of)(estimates[-1:], truths[-1:])[0]
        if pair.clean_source is not None and pair.clean_target is not None:
            chamfer[index] = metrics.chamfer(
                estimates[-1], pair.source, pair.target, pair.clean_source, pair.clean_target
            )
    whole = all(pair.clean_source is not None and pair.clean_target is not None for pair in pairs)
    return Measured(
        name=name,
        err_r=err_r,
        err_t=err_t,
        chamfer=chamfer if whole else None,
        by_axis=by_axis,
        seconds=seconds,
        failures={k: r.failure for k, r in records.by_pair.items() if r.failure is not None},
        about=records.made_with,
        started=records.started,
        modules=records.modules,
    )


def only(measured: Measured, rows: Int[np.ndarray, " k"]) -> Measured:
    """The same of some of the pairs."""
    places = {int(row): place for place, row in enumerate(rows)}
    return dataclasses.replace(
        measured,
        err_r=measured.err_r[rows],
        err_t=measured.err_t[rows],
        chamfer=None if measured.chamfer is None else measured.chamfer[rows],
        by_axis={name: errors[rows] for name, errors in measured.by_axis.items()},
        seconds=measured.seconds[rows],
        failures={places[k]: why for k, why in measured.failures.items() if k in places},
    )


def summarize(
    measured: Measured, thresholds: Sequence[tuple[float, float]], seed: int
) -> dict[str, Statistic | None]:
    """Mean and median errors over the pairs answered, errors by axis, and recalls over all pairs.

    Each with its bootstrap interval; None where nothing was answered or is not measured.
    """
    answered = measured.answered
    errors = {
        "err_r": measured.err_r[answered, -1],
        "err_t": measured.err_t[answered, -1],
        "chamfer": None if measured.chamfer is None else measured.chamfer[answered],
    }
    numbers: dict[str, Statistic | None] = {}
    for name, values in errors.items():
        for kind, statistic in (("mean", np.mean), ("median", np.median)):
            known = values is not None and len(values)
            numbers[f"{name}_{kind}"] = (
                metrics.bootstrap(values, statistic, seed=seed) if known else None
            )
    for name, each in measured.by_axis.items():
        statistic = metrics.root_mean_square if name.endswith("rmse") else np.mean
        values = each[answered]
        numbers[name] = metrics.bootstrap(values, statistic, seed=seed) if len(values) else None
    for angle, distance in thresholds:
        hits = measured.recalled(angle, distance).astype(float)
        numbers[recall_name(angle, distance)] = metrics.bootstrap(hits, seed=seed)
    return numbers


def recall_name(angle: float, distance: float) -> str:
    """Recall within (5, 0.1) is called `recall_5deg_0.1`."""
    return f"recall_{angle:g}deg_{distance:g}"
