"""The probability that a registration is right, from what it shows of itself."""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from cfr_jax import rigid
from cfr_jax.quality import Quality
from cfr_jax.refinement import Surface
from cfr_jax.registration import Registration

FITTED = Path(__file__).parent / "models" / "confidence.json"


@struct.dataclass
class Clues:
    """What tells right answers from wrong ones; each is a number of order one."""

    fitness: Float[Array, ""]
    distance: Float[Array, ""]
    """Inlier RMSE, in unit spheres, times 20."""
    source_found: Float[Array, ""]
    """Mean correspondence weight of the source."""
    target_found: Float[Array, ""]
    settled: Float[Array, ""]
    """How far the network's last iteration still turned: log of degrees + 0.1."""
    agreement: Float[Array, ""]
    """How far refinement turned the network's answer: log of degrees + 0.1."""
    resistance: Float[Array, ""]
    """Square root of the weakest resistance to a nudge."""


def gather(
    registration: Registration,
    source: Surface,
    target: Surface,
    transform: Float[Array, "4 4"],
    quality: Quality,
) -> Clues:
    """The clues of an answer `transform` (source onto target)."""

    def mean(values, mask):
        valid = mask.astype(values.dtype)
        return jnp.sum(values * valid) / jnp.maximum(jnp.sum(valid), 1)

    def turned(a, b):
        return jnp.log(rigid.rotation_error(a, b) + 0.1)

    # a single iteration has none before it, and counts as settled
    before, last = registration.transforms[-2:][0], registration.transforms[-1]
    return Clues(
        fitness=quality.fitness,
        distance=quality.inlier_rmse * 20,
        source_found=mean(registration.weights, source.mask),
        target_found=mean(registration.covered, target.mask),
        settled=turned(before, last),
        agreement=turned(last, transform),
        resistance=jnp.sqrt(jnp.min(quality.resistance)),
    )


def of_alignment(clues: Mapping[str, float]) -> float:
    """Probability in [0, 1] that an answer with these `Clues`, by name, is right to 5 degrees and
    0.1 unit radii.

    Logistic regression on the clues, fitted by `benchmarks/fit_confidence.py` to validation pairs
    with the weights that ship; nearer the truth the closer one's own data are to those.
    """
    fitted = _fitted()
    logit = fitted["bias"] + sum(weight * clues[name] for name, weight in fitted["weights"].items())
    return float(1 / (1 + np.exp(-np.clip(logit, -30, 30))))


@functools.cache
def _fitted():
    return json.loads(FITTED.read_text())
