"""Measures weights again on the shapes that ship with the package, to check published scores."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from cfr_jax.batch.stream import align_many
from cfr_jax.data.corpus import Corpus
from cfr_jax.data.pairs import Pair
from cfr_jax.data.protocol import Protocol, fixed_pair, partial
from cfr_jax.evaluation import metrics
from cfr_jax.networks.record import Params
from cfr_jax.weights.cards import FOLDER

SHAPES = FOLDER / "held_out.npz"
PAIRS = 48
WHAT = (
    f"{PAIRS} partial, noisy pairs of 24 CC0 shapes of unseen categories, 717 points, normals "
    "estimated from the points"
)
# Room for the rounding of other processors, which can move a borderline pair.
TOLERANCE = {
    "err_r_mean": 1.0,
    "err_r_median": 0.25,
    "recall_1deg_0.02": 0.07,
    "recall_5deg_0.1": 0.07,
}
STAGES = ("network", "refined")
Scores = dict[str, dict[str, float]]


def read_shapes() -> Corpus:
    """The held-out shapes (credits are in `weights/shipped/held_out.md`)."""
    with np.load(SHAPES, allow_pickle=False) as held:
        categories = tuple(sorted(set(held["categories"].tolist())))
        normals = held["normals"].astype(np.float32)
        return Corpus(
            points=held["points"].astype(np.float32) / np.float32(32767),
            normals=normals / np.linalg.norm(normals, axis=-1, keepdims=True),
            labels=np.array([categories.index(name) for name in held["categories"].tolist()]),
            names=tuple(held["names"].tolist()),
            categories=categories,
        )


def make_pairs(count: int = PAIRS, protocol: Protocol = partial) -> list[Pair]:
    """The first `count` pairs; when a shape comes again, its crop, motion and noise are new."""
    shapes = read_shapes()
    rows = np.arange(count) % len(shapes)
    return [fixed_pair(shapes.take(rows), index, protocol) for index in range(count)]


def measure(params: Params, told: Callable[[], Any] = lambda: None, count: int = PAIRS) -> Scores:
    """Scores of the network alone and after refinement; `told` is called after every pair.

    A pair without an answer counts as a rotation error of 180 degrees and a translation error of 2.
    """
    pairs = make_pairs(count)
    clouds = ((pair.source, pair.target) for pair in pairs)
    errors = np.full((len(STAGES), count, 2), (180.0, 2.0))
    for outcome in align_many(clouds, params=params, ordered=False):
        told()
        if outcome.alignment is None:
            continue
        found, truth = outcome.alignment, np.array(pairs[outcome.index].transform, np.float64)
        for stage, answer in enumerate((found.transforms[-1], found.transform)):
            errors[stage, outcome.index] = (
                metrics.err_r(answer[None], truth[None])[0],
                metrics.err_t(answer[None], truth[None])[0],
            )
    return {name: _scores(*errors[stage].T) for stage, name in enumerate(STAGES)}


def missed(measured: Scores, expected: Scores, tolerance: dict[str, float]) -> list[str]:
    """The scores that are worse than expected by more than the tolerance, in words."""
    worse = []
    for stage, scores in expected.items():
        for name, value in scores.items():
            sign = 1.0 if metrics.lower_is_better(name) else -1.0
            if not sign * (measured[stage][name] - value) <= tolerance[name]:
                worse.append(f"{stage} {name}: {measured[stage][name]:.3g}, published {value:.3g}")
    return worse


def _scores(err_r: np.ndarray, err_t: np.ndarray) -> dict[str, float]:
    rotations = metrics.named("err_r").summaries
    scores = {summary.name: float(summary.statistic(err_r, axis=-1)) for summary in rotations}
    for threshold in ((1.0, 0.02), (5.0, 0.1)):
        summary = metrics.recall(*threshold)
        hits = metrics.recalled(err_r, err_t, *threshold)
        scores[summary.name] = float(summary.statistic(hits, axis=-1))
    return scores
