"""The probability that an alignment is right, from clues of the network and of the surfaces.

Right means within 5 degrees and a tenth of the unit sphere's radius. The probability comes from a
logistic regression on the clues. Its coefficients come with the weights (`networks.probability`)
and are fitted to validation pairs (`cfr calibrate`). The more your data resemble those pairs, the
better the probability holds; docs/confidence.md shows how well it holds on other pairs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from cfr_jax.alignment.quality import Quality
from cfr_jax.networks.clues import NetworkClues, turned
from cfr_jax.networks.probability import SURE, Calibration, logit


@struct.dataclass
class Clues:
    """The clues of a refined answer: the network's, and those that the surfaces add."""

    network: NetworkClues
    fitness: Float[Array, ""]
    distance: Float[Array, ""]
    """The inlier RMSE in units of the unit sphere, times 20."""
    agreement: Float[Array, ""]
    """How far refinement turned the network's answer: the log of (degrees + 0.1)."""
    resistance: Float[Array, ""]
    """The square root of the weakest resistance to a nudge."""


OF_NETWORK = tuple(field.name for field in dataclasses.fields(NetworkClues))
OF_SURFACES = tuple(f.name for f in dataclasses.fields(Clues) if f.name != "network")
NAMES = OF_NETWORK + OF_SURFACES


def gather(
    network: NetworkClues,
    found: Float[Array, "4 4"],
    transform: Float[Array, "4 4"],
    quality: Quality,
) -> Clues:
    """The clues of the answer `transform`, which refinement made from the motion that the network
    `found`."""
    return Clues(
        network=network,
        fitness=quality.fitness,
        distance=quality.inlier_rmse * 20,
        agreement=turned(found, transform),
        resistance=jnp.sqrt(jnp.min(quality.resistance)),
    )


def named(clues: Clues) -> dict[str, float]:
    """All clues of one answer, by name, as Python floats."""
    given = vars(clues.network) | {k: v for k, v in vars(clues).items() if k != "network"}
    return {name: float(value) for name, value in given.items()}


def of_alignment(fitted: Calibration | None, clues: Mapping[str, float]) -> float | None:
    """The probability, in [0, 1], that an answer with these clues (by name) is right. None without
    a calibration."""
    if fitted is None:
        return None
    sure = logit(fitted.align, clues)
    return float(1 / (1 + np.exp(-np.clip(sure, -SURE, SURE))))
