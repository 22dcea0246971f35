"""Errors of the network alone on held-out pairs, at the usual size of clouds."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from cfr_jax.evaluation import metrics
from cfr_jax.networks.record import Params
from cfr_jax.training import devices, step, stopping
from cfr_jax.training.learner import Learner

_RECALL = 5.0, 0.1  # degrees, and radii


def place(batch: dict[str, np.ndarray], mesh: Mesh, pairs_at_once: int = 1) -> dict[str, jax.Array]:
    """Spreads the pairs of `mixture.fixed_pairs` over the devices.

    The last pair is repeated, so that each device has a multiple of `pairs_at_once` pairs (or
    equally many, if they are fewer).
    """
    count = len(batch["transform"])
    share = -(-count // mesh.size)
    share = -(-share // min(pairs_at_once, share)) * min(pairs_at_once, share)
    full = share * mesh.size
    rows = np.minimum(np.arange(full), count - 1)[devices.share_of(full)]
    return devices.spread(jax.tree.map(lambda leaf: leaf[rows], batch), mesh)


def validate(
    chosen: Learner,
    params: Params,
    placed: dict[str, jax.Array],
    truth: np.ndarray,
    mesh: Mesh,
    pairs_at_once: int = 1,
) -> dict[str, Any]:
    """Compares the transforms that the weights find with `truth` (b, 4, 4).

    Returns the rotation errors (degrees) and translation errors of the last transform, their
    recall, the mean rotation error of every iteration, and all transforms (b, L, 4, 4). Raises
    `Diverged` if a transform is not finite.
    """
    found = step.predict(
        params,
        placed,
        unroll=chosen.unroll,
        settings=chosen.validated,
        mesh=mesh,
        pairs_at_once=pairs_at_once,
    )
    transforms = devices.gather(found)[: len(truth)].astype(np.float64)
    truth = np.asarray(truth, np.float64)
    lost = np.count_nonzero(~np.isfinite(transforms).all(axis=(1, 2, 3)))
    if lost:
        raise stopping.Diverged(
            f"the answers of the weights to {lost} of {len(truth)} validation pairs are not "
            "finite.\n"
            "Look for broken shapes among these pairs, or try a lower train.peak_rate"
        )
    rotation = metrics.err_r(transforms[:, -1], truth)
    translation = metrics.err_t(transforms[:, -1], truth)
    recall = metrics.recall(*_RECALL)
    return {
        "rotation_mean": float(rotation.mean()),
        "rotation_median": float(np.median(rotation)),
        "translation_mean": float(translation.mean()),
        recall.name: float(recall.statistic(metrics.recalled(rotation, translation, *_RECALL))),
        "rotation_by_iteration": [
            float(metrics.err_r(transforms[:, i], truth).mean()) for i in range(transforms.shape[1])
        ],
        "transforms": transforms,
    }


def in_words(found: dict[str, Any]) -> str:
    """A validation in words, on one line."""
    return (
        f"validation RE {found['rotation_mean']:.2f}° mean, "
        f"{found['rotation_median']:.2f}° median, TE {found['translation_mean']:.3f}, "
        f"recall (5°, 0.1) {found['recall_5deg_0.1']:.2f}"
    )
