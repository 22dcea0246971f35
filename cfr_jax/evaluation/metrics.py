"""Metrics: how far an estimated motion is from the truth, and how to summarize such errors.

All metrics are in one table, which all code that measures or shows errors looks up.

Everything is float64 numpy on the host, for P pairs at a time. Motions are (4, 4), rigid, and map
source onto target. Lengths are in the unit of the clouds, angles in degrees.

The definitions are those of RPM-Net (Yew & Lee, 2020), so the numbers compare with published ones.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cfr_jax.data.pairs import Pair
from cfr_jax.geometry import motions

Motions = Float[np.ndarray, "_pairs 4 4"]
Errors = Float[np.ndarray, " _pairs"]


def err_r(estimates: Motions, truths: Motions) -> Errors:
    """Angle of the rotation that remains between estimate and truth, in degrees.

    arccos((tr(R_truth^T R) - 1) / 2), as published. It is inexact for small angles: an error e in
    the trace appears as sqrt(e). Equal rotations in float64 can measure up to 5e-6 degrees, and
    equal rotations rounded to float32 up to 0.03.
    """
    estimates, truths = _checked(estimates, truths)
    trace = np.einsum("pij,pij->p", truths[:, :3, :3], estimates[:, :3, :3])
    return np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


def err_t(estimates: Motions, truths: Motions) -> Errors:
    """Length of the translation of truth^-1 estimate; equal to that of the difference of both."""
    estimates, truths = _checked(estimates, truths)
    return np.linalg.norm(estimates[:, :3, 3] - truths[:, :3, 3], axis=-1)


def r_mae(estimates: Motions, truths: Motions) -> Errors:
    """Mean absolute difference of the three Euler angles ('xyz', about fixed axes), in degrees."""
    return np.abs(_euler_difference(estimates, truths)).mean(axis=-1)


def r_rmse(estimates: Motions, truths: Motions) -> Errors:
    """Root mean square difference of the three Euler angles, in degrees."""
    return np.sqrt(np.square(_euler_difference(estimates, truths)).mean(axis=-1))


def t_mae(estimates: Motions, truths: Motions) -> Errors:
    """Mean absolute difference of the three coordinates of the translation."""
    estimates, truths = _checked(estimates, truths)
    return np.abs(estimates[:, :3, 3] - truths[:, :3, 3]).mean(axis=-1)


def t_rmse(estimates: Motions, truths: Motions) -> Errors:
    """Root mean square difference of the three coordinates of the translation."""
    estimates, truths = _checked(estimates, truths)
    return np.sqrt(np.square(estimates[:, :3, 3] - truths[:, :3, 3]).mean(axis=-1))


def chamfer(
    estimate: Float[np.ndarray, "4 4"],
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "m 3"],
    clean_source: Float[np.ndarray, "k 3"],
    clean_target: Float[np.ndarray, "l 3"],
) -> float:
    """Modified Chamfer distance of one pair, squared: from each cloud to the other's whole shape.

    The clean clouds have no noise and no crop, and each is in the frame of its cloud. So a good
    estimate is not penalized for what the crop removed.
    """
    source, target = _finite("source", source), _finite("target", target)
    clean_source = _finite("clean_source", clean_source)
    clean_target = _finite("clean_target", clean_target)
    estimate = _finite("estimate", estimate)
    forward, _ = cKDTree(clean_target).query(motions.apply(estimate, source))
    backward, _ = cKDTree(motions.apply(estimate, clean_source)).query(target)
    return float(np.square(forward).mean() + np.square(backward).mean())


def recalled(
    angles: Errors, distances: Errors, angle: float, distance: float
) -> Bool[np.ndarray, " _pairs"]:
    """Which pairs have `err_r` below `angle` degrees and `err_t` below `distance`."""
    return (np.asarray(angles) < angle) & (np.asarray(distances) < distance)


def root_mean_square(values: np.ndarray, axis: int) -> np.ndarray | np.floating:
    """A statistic for `bootstrap`: one root over all axes of all pairs, not a mean of roots."""
    return np.sqrt(np.square(values).mean(axis=axis))


def _euler_difference(estimates: Motions, truths: Motions) -> Float[np.ndarray, "p 3"]:
    """Differences of the Euler angles, not wrapped at 180 degrees, as in the published numbers."""
    estimates, truths = _checked(estimates, truths)
    with warnings.catch_warnings():
        # At gimbal lock, several choices of angles describe the same rotation; any will do.
        warnings.filterwarnings("ignore", message="Gimbal lock")
        angles = [
            Rotation.from_matrix(given[:, :3, :3]).as_euler("xyz", degrees=True)
            for given in (estimates, truths)
        ]
    return angles[0] - angles[1]


def _checked(estimates: Motions, truths: Motions) -> tuple[Motions, Motions]:
    estimates, truths = _finite("estimates", estimates), _finite("truths", truths)
    if estimates.ndim != 3 or estimates.shape[1:] != (4, 4) or estimates.shape != truths.shape:
        raise ValueError(
            f"estimates is {estimates.shape} and truths {truths.shape}, wanted (P, 4, 4) for both"
        )
    return estimates, truths


def _finite(name: str, values: np.ndarray) -> np.ndarray:
    values = np.asarray(values, np.float64)
    if not np.isfinite(values).all():
        raise ValueError(f"{name} holds numbers that are not finite")
    return values


@dataclass(frozen=True)
class Summary:
    """A number that summarizes errors over pairs."""

    name: str
    """The name in results.json and on the cards of weights."""
    statistic: Callable[..., np.ndarray | np.floating]
    """Takes an array and an `axis`."""
    title: str | None = None
    """The title of its column in the table; None: it appears only in results.json."""
    scale: float = 1.0
    form: str = ".3f"
    """The format in which the table writes it, after multiplying by `scale`."""


@dataclass(frozen=True)
class Metric:
    """One way to measure how good the estimates for a pair are."""

    name: str
    of: Callable[[Motions, Pair], Errors]
    """Errors of several estimates (i, 4, 4) of one pair."""
    label: str
    """Its description in plots."""
    unit: str | None
    """None for the unit of the clouds."""
    summaries: tuple[Summary, ...]
    lower_is_better: bool = True
    each_iteration: bool = False
    """Whether it is measured after every iteration, not only for the answer."""
    whole_shapes: bool = False
    """Whether it needs the whole shapes that the clouds of a pair are parts of."""

    def axis_label(self, unit: str) -> str:
        """The label of its axis in a plot, for clouds in `unit`."""
        return f"{self.label} ({self.unit or unit})"


def _to_truth(function: Callable[[Motions, Motions], Errors]) -> Callable[[Motions, Pair], Errors]:
    def of(estimates: Motions, pair: Pair) -> Errors:
        assert pair.transform is not None  # only pairs with a truth are measured
        return function(estimates, np.broadcast_to(pair.transform, estimates.shape))

    return of


def _chamfer_of(estimates: Motions, pair: Pair) -> Errors:
    assert pair.clean_source is not None and pair.clean_target is not None
    clouds = pair.source, pair.target, pair.clean_source, pair.clean_target
    return np.array([chamfer(estimate, *clouds) for estimate in estimates])


def _mean_and_median(name: str, title: str, form: str, scale: float = 1.0) -> tuple[Summary, ...]:
    end = f" ×{scale:g}" if scale != 1 else ""
    return tuple(
        Summary(f"{name}_{kind}", statistic, f"{title} {kind}{end}", scale, form)
        for kind, statistic in (("mean", np.mean), ("median", np.median))
    )


def _each_iteration(
    function: Callable[[Motions, Motions], Errors],
    label: str,
    unit: str | None,
    summaries: tuple[Summary, ...],
) -> Metric:
    name = function.__name__
    return Metric(name, _to_truth(function), label, unit, summaries, each_iteration=True)


def _by_axis(
    function: Callable[[Motions, Motions], Errors], label: str, unit: str | None
) -> Metric:
    name = function.__name__
    statistic = root_mean_square if name.endswith("rmse") else np.mean
    return Metric(name, _to_truth(function), label, unit, (Summary(name, statistic),))


_CHAMFER = _mean_and_median("chamfer", "CD", ".3f", 1e3)
_ALL = (
    _each_iteration(err_r, "rotation error", "degrees", _mean_and_median("err_r", "RE", ".2f")),
    _each_iteration(err_t, "translation error", None, _mean_and_median("err_t", "TE", ".4f")),
    Metric("chamfer", _chamfer_of, "Chamfer distance", "squared", _CHAMFER, whole_shapes=True),
    _by_axis(r_mae, "mean error of the Euler angles", "degrees"),
    _by_axis(r_rmse, "root mean square error of the Euler angles", "degrees"),
    _by_axis(t_mae, "mean error of the coordinates", None),
    _by_axis(t_rmse, "root mean square error of the coordinates", None),
)
_TABLE = {metric.name: metric for metric in _ALL}


def entries() -> tuple[Metric, ...]:
    """All metrics, in the order of the columns."""
    return tuple(_TABLE.values())


def named(name: str) -> Metric:
    """The metric of that name; raises KeyError for an unknown name."""
    return _TABLE[name]


def add(new: Metric) -> None:
    """Adds a metric to the table. Raises ValueError if its name is taken."""
    if not isinstance(new, Metric):
        raise ValueError(f"new: got {new!r}, wanted a Metric")
    if new.name in _TABLE:
        raise ValueError(f"name: got {new.name!r}, wanted one that is not taken")
    _TABLE[new.name] = new


def recall(angle: float, distance: float, unit: str = "") -> Summary:
    """The share of pairs that are `recalled`; for (5, 0.1) its name is `recall_5deg_0.1`."""
    title = f"recall {angle:g}°, {distance:g}{' ' + unit if unit else ''}"
    return Summary(f"recall_{angle:g}deg_{distance:g}", np.mean, title)


def lower_is_better(name: str) -> bool:
    """Whether a lower value of the summary of this name is better; false for recalls."""
    of = (m.lower_is_better for m in _TABLE.values() for s in m.summaries if s.name == name)
    return next(of, False)
