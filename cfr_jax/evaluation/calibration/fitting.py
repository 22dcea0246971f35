"""Fits the confidences of `register` and `align` to answers that are known to be right or wrong.

Both are logistic regressions on clues (`networks.probability`). Right means within 5 degrees and a
tenth of the radius.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize

from cfr_jax.alignment import confidence, solving
from cfr_jax.alignment.align import align
from cfr_jax.alignment.planning import SETTINGS, planned
from cfr_jax.evaluation import metrics
from cfr_jax.evaluation.calibration.trials import Trial, Trials
from cfr_jax.networks.cfr.registration import Registration, register
from cfr_jax.networks.probability import BIAS, KEY, Calibration, calibration_of, uncalibrated
from cfr_jax.networks.record import Params
from cfr_jax.weights.files import load_params

USED = {"register": confidence.OF_NETWORK, "align": confidence.NAMES}
"""The clues of each confidence."""
_RIGHT = 5.0, 0.1  # degrees, radii
_LEAST = 10  # right answers, and wrong answers, that a fit needs at least
_PENALTY = 1e-3  # on the squared weights, because the clues overlap
_DIGITS = 4
_FOLDS = 5


@dataclasses.dataclass(frozen=True)
class Gathered:
    """The findings of `n` trials: clues, whether `register` and `align` were right, the group."""

    clues: dict[str, Float[np.ndarray, "n c"]]
    right: dict[str, Bool[np.ndarray, " n"]]
    group: Int[np.ndarray, " n"]


def gather(
    params: Params,
    trials: Trials,
    count: int,
    *,
    kept: Path | None = None,
    made_of: str = "",
    told: Callable[[int], object] = lambda _: None,
) -> Gathered:
    """Registers the first `count` trials with the weights `params` and gathers the findings.

    The second look of `align` needs a calibration: that of the parameters, or if they have none,
    that of the shipped default weights. With `kept`, an .npz file, an interrupted call resumes from
    that file; `made_of` says what the answers depend on. `told` is called with the number of trials
    done since its last call. Raises ValueError if the file was made with another `made_of`.
    """
    if calibration_of(params) is None:
        params = {**params, KEY: calibration_of(load_params())}
    rows = _kept_rows(kept, made_of)[:count]
    told(len(rows))
    for number in range(len(rows), count):
        rows.append(_row(params, trials.trial(number)))
        if kept is not None and (len(rows) % 10 == 0 or len(rows) == count):
            np.savez(kept, rows=np.array(rows), made_of=_digest(made_of))
        told(1)
    held = np.array(rows)
    of_network = len(confidence.OF_NETWORK)
    clues = {"register": held[:, :of_network], "align": held[:, of_network:-3]}
    right = dict(zip(clues, held[:, -3:-1].T.astype(bool), strict=True))
    return Gathered(clues, right, held[:, -1].astype(int))


def check_enough(found: Gathered) -> None:
    """Raises ValueError if too few answers were right, or too few wrong, for a fit."""
    for name, right in found.right.items():
        if min(right.sum(), (~right).sum()) < _LEAST:
            raise ValueError(
                f"pairs: {name} answered {right.sum()} right and {(~right).sum()} wrong, wanted at "
                f"least {_LEAST} of each; use more pairs or other data"
            )


def fit_calibration(found: Gathered) -> Calibration:
    """The calibration that fits the findings."""
    fitted = {}
    for name, clues in USED.items():
        *weights, bias = fit(found.clues[name], found.right[name]).round(_DIGITS).tolist()
        fitted[name] = {BIAS: bias} | dict(zip(clues, weights, strict=True))
    return Calibration.of(**fitted)


def fit(clues: Float[np.ndarray, "n c"], right: Bool[np.ndarray, " n"]) -> np.ndarray:
    """Weights (c,) and the bias of a penalized logistic regression, for clues as given."""
    center, spread = clues.mean(axis=0), clues.std(axis=0) + 1e-9
    design = np.column_stack([(clues - center) / spread, np.ones(len(clues))])

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        logit = design @ weights
        chance = 1 / (1 + np.exp(-logit))
        value = np.mean(np.logaddexp(0, logit) - right * logit) + _PENALTY * weights @ weights
        return value, design.T @ (chance - right) / len(right) + 2 * _PENALTY * weights

    found = minimize(loss, np.zeros(design.shape[1]), jac=True, method="BFGS").x
    weights = found[:-1] / spread
    return np.append(weights, found[-1] - weights @ center)


def predict(fitted: np.ndarray, clues: Float[np.ndarray, "n c"]) -> Float[np.ndarray, " n"]:
    """The probability that each answer is right; `fitted` is what `fit` returned."""
    return 1 / (1 + np.exp(-(clues @ fitted[:-1] + fitted[-1])))


def cross_validated(found: Gathered, name: str) -> Float[np.ndarray, " n"]:
    """The probability of each answer, from a fit to other shapes or pairs."""
    clues, right = found.clues[name], found.right[name]
    chance = np.zeros(len(right))
    for fold in range(_FOLDS):
        held = found.group % _FOLDS == fold
        if held.any():
            chance[held] = predict(fit(clues[~held], right[~held]), clues[held])
    return chance


def predicted(calibration: Calibration, found: Gathered, name: str) -> Float[np.ndarray, " n"]:
    """The probability of each answer, from a calibration."""
    fitted = dict(getattr(calibration, name))
    weights = [fitted[clue] for clue in USED[name]]
    return predict(np.array([*weights, fitted[BIAS]]), found.clues[name])


def _row(params: Params, trial: Trial) -> list[float]:
    """The clues of both answers to a trial, whether each is right, and the trial's group."""
    found = align(
        trial.source, trial.target, params=params, initial="global" if trial.searched else None
    )
    # `register` by itself runs one cascade and takes no second look
    plan = planned(trial.source, trial.target, initial=found.initial if trial.searched else None)
    arguments = solving.on_device(plan.source, plan.target)
    alone = _register(uncalibrated(params), *arguments)
    of_network = [float(getattr(alone.clues, name)) for name in confidence.OF_NETWORK]
    right = [False, False]
    if trial.truth is not None:
        answers = [plan.frames.to_caller(np.asarray(alone.transform)), found.transform]
        radius = plan.frames.scale if trial.radius is None else trial.radius
        right = [is_right(answer, trial.truth, trial.center, radius) for answer in answers]
    of_align = [found.clues[name] for name in confidence.NAMES]
    return [*of_network, *of_align, *map(float, right), float(trial.group)]


def is_right(
    answer: Float[np.ndarray, "4 4"],
    truth: Float[np.ndarray, "4 4"],
    center: tuple[float, float, float],
    radius: float,
) -> bool:
    """Whether an answer is within 5 degrees of the truth and moves `center` to within a tenth of
    `radius` of its true position."""
    angle = metrics.err_r(answer[None], truth[None])[0]
    away = (answer - truth) @ np.array([*center, 1.0])
    return bool(angle < _RIGHT[0] and np.linalg.norm(away[:3]) < _RIGHT[1] * radius)


@jax.jit
def _register(
    params: Params, source: solving.DeviceCloud, target: solving.DeviceCloud
) -> Registration:
    return register(params, source.prepared(), target.prepared(), settings=SETTINGS)


def _kept_rows(kept: Path | None, made_of: str) -> list[list[float]]:
    if kept is None or not kept.exists():
        return []
    try:
        with np.load(kept, allow_pickle=False) as held:
            rows, digest = held["rows"], str(held["made_of"])
    except (OSError, ValueError, KeyError) as error:
        raise ValueError(f"keep: {kept} does not hold findings of trials ({error})") from error
    if digest != _digest(made_of):
        raise ValueError(f"keep: {kept} was gathered with other weights, data, seed, or clues")
    return rows.tolist()


def _digest(made_of: str) -> str:
    return hashlib.sha256(repr((made_of, USED)).encode()).hexdigest()
