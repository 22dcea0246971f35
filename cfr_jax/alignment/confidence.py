"""The probability that an alignment is right, from the network's clues and from the surfaces.

Right means within 5 degrees and a tenth of the unit sphere's radius. The probability is a logistic
regression on clues, whose coefficients come with the weights (`networks.probability`): they are
fitted to validation pairs (`cfr calibrate`; docs/confidence.md shows how well that holds on other
pairs). It is nearer the truth the closer one's own data are to those.
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
    """What also the surfaces tell of a refined answer."""

    network: NetworkClues
    fitness: Float[Array, ""]
    distance: Float[Array, ""]
    """Inlier RMSE, in unit spheres, times 20."""
    agreement: Float[Array, ""]
    """How far refinement turned the network's answer: log of degrees + 0.1."""
    resistance: Float[Array, ""]
    """Square root of the weakest resistance to a nudge."""


OF_NETWORK = tuple(field.name for field in dataclasses.fields(NetworkClues))
OF_SURFACES = tuple(f.name for f in dataclasses.fields(Clues) if f.name != "network")
NAMES = OF_NETWORK + OF_SURFACES


def gather(
    network: NetworkClues,
    found: Float[Array, "4 4"],
    transform: Float[Array, "4 4"],
    quality: Quality,
) -> Clues:
    """The clues of an answer `transform`, after a network that `found` another."""
    return Clues(
        network=network,
        fitness=quality.fitness,
        distance=quality.inlier_rmse * 20,
        agreement=turned(found, transform),
        resistance=jnp.sqrt(jnp.min(quality.resistance)),
    )


def named(clues: Clues) -> dict[str, float]:
    """All clues of one answer by name, as numbers of the host."""
    given = vars(clues.network) | {k: v for k, v in vars(clues).items() if k != "network"}
    return {name: float(value) for name, value in given.items()}


def of_alignment(fitted: Calibration | None, clues: Mapping[str, float]) -> float | None:
    """Probability in [0, 1] that an answer with these `Clues`, by name, is right; None without
    calibration."""
    if fitted is None:
        return None
    sure = logit(fitted.align, clues)
    return float(1 / (1 + np.exp(-np.clip(sure, -SURE, SURE))))
