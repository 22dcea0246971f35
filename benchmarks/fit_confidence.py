"""Fits the confidences of `register` and of `align` to validation pairs, or measures them.

    python -m benchmarks.fit_confidence --corpus data/open_cad/val.h5 --pairs 500 --fit
    python -m benchmarks.fit_confidence --corpus data/open_cad/test.h5 --pairs 300 \\
        --figure docs/images/confidence.png

Of ten pairs three are of the partial protocol with exact normals and two with estimated ones, three
of these five turned either way about each axis instead of one; two keep only half of each shape
(one with estimated normals); one is turned by any rotation and searched globally; one is turned by
up to 90 degrees about each axis and is not; and one is of two different shapes.

The first form cross-validates by shape, then fits to all pairs and writes
cfr_jax/networks/calibration.py.
The second measures what ships on shapes that it was not fitted to, and draws. `--clues FILE.npz`
keeps what was gathered: a call that was cut off goes on from there.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import tqdm
from scipy.optimize import minimize

from benchmarks import reliability
from cfr_jax.alignment import confidence, solving
from cfr_jax.alignment.align import align
from cfr_jax.alignment.planning import SETTINGS, planned
from cfr_jax.cli.shared.cache import keep_compiled_programs
from cfr_jax.data.corpus import Corpus, read_corpus
from cfr_jax.data.protocol import (
    low_overlap,
    partial,
    partial_any_rotation,
    partial_both_ways,
    random_pair,
)
from cfr_jax.evaluation import metrics
from cfr_jax.networks import calibration
from cfr_jax.networks.cfr.registration import register
from cfr_jax.networks.clues import NetworkClues
from cfr_jax.runtime.atomic import write_atomically
from cfr_jax.weights.files import load_params

OF_NETWORK = tuple(field.name for field in dataclasses.fields(NetworkClues))
OF_SURFACES = tuple(f.name for f in dataclasses.fields(confidence.Clues) if f.name != "network")
CLUES = OF_NETWORK + OF_SURFACES
USED = {"REGISTER": OF_NETWORK, "ALIGN": CLUES}
_PENALTY = 1e-3  # on the squared weights: clues overlap
_TURNED = dataclasses.replace(partial, name="turned", angle=90.0)
# protocol, whether normals are estimated
_MIX = (
    (partial, False), *[(partial_both_ways, False)] * 2, (partial, True),
    (partial_both_ways, True), (low_overlap, False), (low_overlap, True),
    (partial_any_rotation, False), (_TURNED, False), (partial, True),
)  # fmt: skip
_SEARCHED, _DIFFERENT = 7, 9  # places in the mix
_FOLDS = 5


@dataclasses.dataclass
class Gathered:
    """What was found of `n` pairs: clues, whether register and align were right, the shape."""

    clues: dict[str, np.ndarray]
    right: dict[str, np.ndarray]
    shape: np.ndarray


def gather(corpus: Corpus, count: int, seed: int, kept: Path | None) -> Gathered:
    """The first `count` pairs of the mix; each depends on its number alone."""
    rows: list[list[float]] = []
    if kept is not None and kept.exists():
        rows = np.load(kept)["rows"][:count].tolist()
        if len(rows[0]) != len(OF_NETWORK) + len(CLUES) + 3:
            raise SystemExit(f"fit_confidence: error: {kept} holds other clues; wanted a new file")
    for number in tqdm.trange(len(rows), count, initial=len(rows), total=count):
        rows.append(_row(corpus, number, np.random.default_rng((seed, number))))
        if kept is not None and (len(rows) % 10 == 0 or len(rows) == count):
            np.savez(kept, rows=np.array(rows))
    held = np.array(rows)
    clues = {"REGISTER": held[:, : len(OF_NETWORK)], "ALIGN": held[:, len(OF_NETWORK) : -3]}
    right = dict(zip(clues, held[:, -3:-1].T.astype(bool), strict=True))
    return Gathered(clues, right, held[:, -1].astype(int))


def _row(corpus, number, rng):
    protocol, estimated = _MIX[number % len(_MIX)]
    shape, other = (int(rng.integers(len(corpus))) for _ in range(2))
    pair = random_pair(*corpus[shape], protocol, rng)
    target = pair
    if number % len(_MIX) == _DIFFERENT:
        target = random_pair(*corpus[other], protocol, rng)
    clouds = (pair.source, pair.source_normals), (target.target, target.target_normals)
    given = [points if estimated else np.hstack([points, normals]) for points, normals in clouds]
    searched = number % len(_MIX) == _SEARCHED
    found = align(*given, initial="global" if searched else None)
    # `register` alone makes one cascade, and takes no second look
    plan = planned(*given, initial=found.initial if searched else None)
    arguments = solving.on_device(plan.source), solving.on_device(plan.target)
    alone = _register(load_params(), *arguments)
    answers = np.stack([plan.frames.to_caller(np.asarray(alone.transform)), found.transform])
    truth = np.repeat(pair.transform[None].astype(float), 2, axis=0)
    errors = metrics.err_r(answers, truth), metrics.err_t(answers, truth)
    right = metrics.recalled(*errors, 5.0, 0.1) & (target is pair)
    of_network = (float(getattr(alone.clues, name)) for name in OF_NETWORK)
    return [*of_network, *(found.clues[name] for name in CLUES), *right, shape]


@jax.jit
def _register(params, source, target):
    clouds = source.prepared(), target.prepared()
    return register(params, *clouds, settings=SETTINGS)


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


def cross_validated(clues: np.ndarray, right: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """The probability of each answer by a fit to the other shapes."""
    chance = np.zeros(len(right))
    for fold in range(_FOLDS):
        held = shape % _FOLDS == fold
        chance[held] = predict(fit(clues[~held], right[~held]), clues[held])
    return chance


def shipped(name: str, clues: np.ndarray) -> np.ndarray:
    """The probability of each answer by what ships."""
    fitted = getattr(calibration, name)
    weights = [fitted[clue] for clue in USED[name]]
    return predict(np.array([*weights, fitted["bias"]]), clues)


def main() -> None:
    """Gathers, then fits or measures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--corpus", required=True, help="HDF5 file of shapes")
    parser.add_argument("--pairs", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--clues", type=Path, help="keep what is gathered in this .npz")
    parser.add_argument("--fit", action="store_true", help="write cfr_jax/networks/calibration.py")
    parser.add_argument("--figure", type=Path, help="draw reliability and rejection")
    args = parser.parse_args()
    keep_compiled_programs()
    found = gather(read_corpus(args.corpus), args.pairs, args.seed, args.clues)
    curves = {}
    for name, right in found.right.items():
        clues = found.clues[name]
        chance = cross_validated(clues, right, found.shape) if args.fit else shipped(name, clues)
        curves[name.lower()] = chance, right
        print(name, json.dumps(reliability.summary(chance, right)))
    if args.fit:
        _write_calibration(found)
    if args.figure is not None:
        reliability.draw(args.figure, curves)


def _write_calibration(found: Gathered) -> None:
    lines = [calibration.__doc__.rstrip("\n")]
    text = f'"""{lines[0]}\n"""\n'
    for name, clues in USED.items():
        fitted = fit(found.clues[name], found.right[name])
        text += f'\n{name} = {{\n    "bias": {fitted[-1]:.4f},\n'
        text += "".join(f'    "{c}": {w:.4f},\n' for c, w in zip(clues, fitted[:-1], strict=True))
        text += "}\n"
    write_atomically(Path(calibration.__file__), text.encode())


if __name__ == "__main__":
    main()
