"""Fits the confidence of `align` to validation pairs, and says how well it is calibrated.

    python -m benchmarks.fit_confidence --corpus ../shared/data/open_cad/val.h5

Pairs: the partial protocol with estimated normals; beside them, so that wrong answers of every kind
are seen, rotations of up to 180 degrees and pairs of two different shapes. Half of the shapes fit
the logistic regression, the other half measures it; what ships is fitted to all. Writes
cfr_jax/models/confidence.json. Validation shapes only: never the test set.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

import numpy as np
import tqdm
from scipy.optimize import minimize

from cfr_jax import confidence, metrics
from cfr_jax.alignment import align
from cfr_jax.data.corpus import Corpus, read_corpus
from cfr_jax.data.protocol import Protocol, partial, random_pair
from cfr_jax.viewer.atomic import write_atomically

CLUES = tuple(field.name for field in dataclasses.fields(confidence.Clues))
_PENALTY = 1e-3  # on the squared weights: clues overlap
_TURNED = dataclasses.replace(partial, name="turned", angle=180.0)


def gather(corpus: Corpus, count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Clues (n, c), whether the answer was right (n,), and the shape's number (n,)."""
    rng = np.random.default_rng(seed)
    clues, right, shapes = [], [], []
    for number in tqdm.trange(count):
        shape = int(rng.integers(len(corpus)))
        kind = number % 8  # of eight pairs six by the protocol, one turned, one of two shapes
        protocol: Protocol = _TURNED if kind == 6 else partial
        pair = random_pair(*corpus[shape], protocol, rng)
        target = pair.target
        if kind == 7:
            other = int(rng.integers(len(corpus)))
            target = random_pair(*corpus[other], partial, rng).target
        found = align(pair.source, target)
        truth, estimate = pair.transform[None].astype(float), found.transform[None]
        errors = metrics.err_r(estimate, truth), metrics.err_t(estimate, truth)
        close = metrics.recalled(*errors, 5.0, 0.1)[0]
        clues.append([found.clues[name] for name in CLUES])
        right.append(bool(close) and kind != 7)
        shapes.append(shape)
    return np.array(clues), np.array(right), np.array(shapes)


def fit(clues: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Weights (c,) and bias of a penalized logistic regression, for clues as they are."""
    center, spread = clues.mean(axis=0), clues.std(axis=0) + 1e-9
    design = np.column_stack([(clues - center) / spread, np.ones(len(clues))])

    def loss(weights):
        logit = design @ weights
        chance = 1 / (1 + np.exp(-logit))
        value = np.mean(np.logaddexp(0, logit) - right * logit) + _PENALTY * weights @ weights
        return value, design.T @ (chance - right) / len(right) + 2 * _PENALTY * weights

    found = minimize(loss, np.zeros(design.shape[1]), jac=True, method="BFGS").x
    weights = found[:-1] / spread
    return np.append(weights, found[-1] - weights @ center)


def predict(fitted: np.ndarray, clues: np.ndarray) -> np.ndarray:
    """Probability that each answer is right."""
    return 1 / (1 + np.exp(-(clues @ fitted[:-1] + fitted[-1])))


def calibration_error(chance: np.ndarray, right: np.ndarray, bins: int = 10) -> float:
    """Expected calibration error over bins of equal width."""
    place = np.minimum((chance * bins).astype(int), bins - 1)
    gaps = [
        abs(chance[place == b].mean() - right[place == b].mean()) * np.mean(place == b)
        for b in range(bins)
        if np.any(place == b)
    ]
    return float(sum(gaps))


def ranking(chance: np.ndarray, right: np.ndarray) -> float:
    """Area under the ROC curve: how often a right answer is given more than a wrong one."""
    above = chance[right][:, None] - chance[~right][None, :]
    return float(np.mean(above > 0) + np.mean(above == 0) / 2)


def main() -> None:
    """Gathers, checks on held-out shapes, fits to all, writes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--corpus", required=True, help="HDF5 file of validation shapes")
    parser.add_argument("--pairs", type=int, default=800)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=confidence.FITTED)
    args = parser.parse_args()
    clues, right, shapes = gather(read_corpus(args.corpus), args.pairs, args.seed)
    held = shapes % 2 == 1
    chance = predict(fit(clues[~held], right[~held]), clues[held])
    report = {
        "pairs": len(right),
        "right": round(float(right.mean()), 3),
        "held_out_calibration_error": round(calibration_error(chance, right[held]), 3),
        "held_out_roc_area": round(ranking(chance, right[held]), 3),
    }
    fitted = fit(clues, right)
    weights = {name: round(float(w), 4) for name, w in zip(CLUES, fitted[:-1], strict=True)}
    content = {"bias": round(float(fitted[-1]), 4), "weights": weights, "fit": report}
    write_atomically(args.out, (json.dumps(content, indent=2) + "\n").encode())
    print(json.dumps(content, indent=2))


if __name__ == "__main__":
    main()
