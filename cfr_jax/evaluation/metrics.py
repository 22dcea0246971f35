"""How far an estimated motion is from the truth, and what a set of such errors says.

Everything is float64 numpy on the host, over P pairs at a time. Motions are (4, 4), map source onto
target, and are rigid; lengths are in the unit of the clouds, angles in degrees.

The definitions are those of RPM-Net (Yew & Lee, 2020), so that numbers stand beside published ones.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cfr_jax.geometry import motions

Motions = Float[np.ndarray, "_pairs 4 4"]
Errors = Float[np.ndarray, " _pairs"]


class Statistic(NamedTuple):
    """A number over a set of pairs, and its 95 % interval over such sets."""

    value: float
    low: float
    high: float


def err_r(estimates: Motions, truths: Motions) -> Errors:
    """Angle of the rotation left between estimate and truth, in degrees.

    arccos((tr(R_truth^T R) - 1) / 2) as published. It cannot see small angles: an error e in the
    trace reads as sqrt(e). Equal float64 rotations answer up to 5e-6 degrees, and rotations
    rounded to float32 up to 0.03.
    """
    estimates, truths = _checked(estimates, truths)
    trace = np.einsum("pij,pij->p", truths[:, :3, :3], estimates[:, :3, :3])
    return np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


def err_t(estimates: Motions, truths: Motions) -> Errors:
    """Length of the translation of truth^-1 after the estimate, which is that of the difference."""
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
    """Modified Chamfer distance of one pair, squared: each cloud against the other's whole shape.

    The clean clouds are without noise and crop, each in the frame of its cloud, so a good estimate
    is not charged for what a crop took away.
    """
    clouds = [
        _finite("source", source),
        _finite("target", target),
        _finite("clean_source", clean_source),
        _finite("clean_target", clean_target),
    ]
    source, target, clean_source, clean_target = clouds
    estimate = _finite("estimate", estimate)
    forward, _ = cKDTree(clean_target).query(motions.apply(estimate, source))
    backward, _ = cKDTree(motions.apply(estimate, clean_source)).query(target)
    return float(np.square(forward).mean() + np.square(backward).mean())


def recalled(
    angles: Errors, distances: Errors, angle: float, distance: float
) -> Bool[np.ndarray, " _pairs"]:
    """Which pairs have `err_r` below `angle` degrees and `err_t` below `distance`."""
    return (np.asarray(angles) < angle) & (np.asarray(distances) < distance)


def bootstrap(
    values: Errors,
    statistic: Callable[..., np.ndarray | np.floating] = np.mean,
    resamples: int = 2000,
    seed: int = 0,
) -> Statistic:
    """A statistic with its 95 % percentile interval (Efron, 1979) over drawing the pairs anew.

    `statistic` takes an array and an `axis`. The same seed draws the same pairs, so the intervals
    of two methods on one set of pairs are comparable.
    """
    values = _finite("values", values)
    if values.ndim != 1 or not len(values):
        raise ValueError(f"values has shape {values.shape}, wanted (P,) with at least one pair")
    draws = np.random.default_rng(seed).integers(len(values), size=(resamples, len(values)))
    low, high = np.percentile(statistic(values[draws], axis=-1), [2.5, 97.5])
    return Statistic(float(statistic(values, axis=-1)), float(low), float(high))


def root_mean_square(values: np.ndarray, axis: int) -> np.ndarray | np.floating:
    """A statistic for `bootstrap`: the root over all axes of all pairs, not a mean of roots."""
    return np.sqrt(np.square(values).mean(axis=axis))


def _euler_difference(estimates: Motions, truths: Motions) -> Float[np.ndarray, "p 3"]:
    """Not wrapped at 180 degrees, as in the published numbers."""
    estimates, truths = _checked(estimates, truths)
    with warnings.catch_warnings():
        # At gimbal lock one of the equal choices of angles is as good as another.
        warnings.filterwarnings("ignore", message="Gimbal lock")
        angles = [
            Rotation.from_matrix(motions[:, :3, :3]).as_euler("xyz", degrees=True)
            for motions in (estimates, truths)
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
