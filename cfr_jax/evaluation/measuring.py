"""From answers to errors, and from errors to the numbers of a table."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from cfr_jax.data.pairs import Pair
from cfr_jax.evaluation import metrics
from cfr_jax.evaluation.store import Records
from cfr_jax.geometry.motions import nearest_motion


class Statistic(NamedTuple):
    """A number computed from a set of pairs, and its 95 % interval over such sets."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Measured:
    """Errors of one method on P pairs, in degrees or the unit of the clouds; NaN if it failed."""

    name: str
    errors: dict[str, Float[np.ndarray, "p _i"]]
    """By the name of the metric, after each iteration that the method reports or for the answer
    alone. The last column is the answer. A metric that does not apply to all pairs is absent."""
    seconds: Float[np.ndarray, " p"]
    failures: dict[int, str]
    about: dict[str, Any]
    started: dict[str, Any] | None
    modules: dict[str, float] | None = None

    @property
    def err_r(self) -> Float[np.ndarray, "p i"]:
        """Rotation errors after each iteration."""
        return self.errors["err_r"]

    @property
    def err_t(self) -> Float[np.ndarray, "p i"]:
        """Translation errors after each iteration."""
        return self.errors["err_t"]

    @property
    def answered(self) -> Bool[np.ndarray, " p"]:
        """Where the method gave an answer."""
        return np.isfinite(self.err_r[:, -1])

    def recalled(self, angle: float, distance: float) -> Bool[np.ndarray, " p"]:
        """Which pairs are solved to this accuracy; failures are not."""
        return metrics.recalled(self.err_r[:, -1], self.err_t[:, -1], angle, distance)

    def milliseconds(self) -> float:
        """Median time over the answered pairs; NaN if there are none."""
        known = self.seconds[self.answered]
        return float(np.median(known) * 1e3) if len(known) else np.nan


def measure(name: str, records: Records, pairs: Sequence[Pair]) -> Measured:
    """The errors of the answers in `records`, for all pairs.

    Estimates are made exactly rigid first, like the truths: rounding to float32 would show up as
    hundredths of a degree.
    """
    answers = {
        index: nearest_motion(np.array(record.transforms))
        for index, record in records.by_pair.items()
        if record.transforms is not None
    }
    iterations = max((len(answer) for answer in answers.values()), default=1)
    whole = all(pair.clean_source is not None and pair.clean_target is not None for pair in pairs)
    errors = {
        metric.name: np.full((len(pairs), iterations if metric.each_iteration else 1), np.nan)
        for metric in metrics.entries()
        if whole or not metric.whole_shapes
    }
    seconds = np.full(len(pairs), np.nan)
    for index, estimates in answers.items():
        told = records.by_pair[index].seconds
        seconds[index] = np.nan if told is None else told
        for metric_name, each in errors.items():
            of = metrics.named(metric_name)
            each[index] = of.of(estimates if of.each_iteration else estimates[-1:], pairs[index])
    return Measured(
        name=name,
        errors=errors,
        seconds=seconds,
        failures={k: r.failure for k, r in records.by_pair.items() if r.failure is not None},
        about=records.made_with,
        started=records.started,
        modules=records.modules,
    )


def only(measured: Measured, rows: Int[np.ndarray, " k"]) -> Measured:
    """The same errors for some of the pairs."""
    places = {int(row): place for place, row in enumerate(rows)}
    return dataclasses.replace(
        measured,
        errors={name: errors[rows] for name, errors in measured.errors.items()},
        seconds=measured.seconds[rows],
        failures={places[k]: why for k, why in measured.failures.items() if k in places},
    )


def summarize(
    measured: Measured, thresholds: Sequence[tuple[float, float]], seed: int
) -> dict[str, Statistic | None]:
    """All summaries of the metrics over the answered pairs, and the recalls over all pairs.

    Each comes with its bootstrap interval. It is None if no pair was answered or measured.
    """
    answered = measured.answered
    numbers: dict[str, Statistic | None] = {}
    for metric in metrics.entries():
        errors = measured.errors.get(metric.name)
        values = np.zeros(0) if errors is None else errors[answered, -1]
        for summary in metric.summaries:
            numbers[summary.name] = (
                bootstrap(values, summary.statistic, seed=seed) if len(values) else None
            )
    for angle, distance in thresholds:
        hits = measured.recalled(angle, distance).astype(float)
        numbers[metrics.recall(angle, distance).name] = bootstrap(hits, seed=seed)
    return numbers


def bootstrap(
    values: Float[np.ndarray, " p"],
    statistic: Callable[..., np.ndarray | np.floating] = np.mean,
    resamples: int = 2000,
    seed: int = 0,
) -> Statistic:
    """A statistic with its 95 % bootstrap interval by percentiles (Efron, 1979).

    Resamples the pairs with replacement. `statistic` takes an array and an `axis`. The same seed
    draws the same pairs, so the intervals of two methods on one set of pairs are comparable. Raises
    ValueError for values that are not finite, and for no values.
    """
    values = np.asarray(values, np.float64)
    if not np.isfinite(values).all():
        raise ValueError("values holds numbers that are not finite")
    if values.ndim != 1 or not len(values):
        raise ValueError(f"values has shape {values.shape}, wanted (P,) with at least one pair")
    draws = np.random.default_rng(seed).integers(len(values), size=(resamples, len(values)))
    low, high = np.percentile(statistic(values[draws], axis=-1), [2.5, 97.5])
    return Statistic(float(statistic(values, axis=-1)), float(low), float(high))
