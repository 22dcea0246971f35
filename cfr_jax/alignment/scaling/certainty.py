"""How sure a factor of scale is.

A plane, a cone, or the corner of a room looks the same at every size: a larger one, shifted, lies
on it as well. On other shapes, a change of the factor takes the points off the surface, however the
rigid motion gives way. How far it takes them is the lever of the factor.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cfr_jax.refine import similarity
from cfr_jax.refine.similarity import Similarity
from cfr_jax.refine.surfaces import HostSurface

# Logistic regression on 157 pairs (partial pairs and pairs of less overlap from val.h5, a fifth of
# the Kinect pairs and a third of the LiDAR pairs, and planes, cones, corners and other solids), of
# which 114 had the right factor. In cross-validation, 5 % of the answers were wrong and trusted,
# half of them by 2 to 6 %, and 3 % right and doubted.
_BIAS, _SPREAD, _SLACK = 2.63, -0.36, -5.12
_USUAL_SLACK, _LEAST_SPREAD, _LEAST_SLACK = 0.06, 1e-3, 1e-3


class Certainty(NamedTuple):
    """What the pairs of closest points say about the factor."""

    lever: float
    """How far the points leave the surface, as a root mean square and in units of the unit sphere,
    when the log of the factor grows by one and the rigid motion gives way."""
    slack: float
    """The change of the log of the factor that takes the points as far off the surface as they
    already are. 0.03 is usual for objects, 0.1 for LiDAR scans, and 0.2 for a plane with noise."""
    error: float
    """The standard error of the log of the factor: the slack by the root of the number of pairs."""
    step: Float[np.ndarray, " 7"]
    """The step of `similarity.moved_by` that changes the log of the factor by one, with the rigid
    motion that gives way most."""
    center: Float[np.ndarray, " 3"]

    def confidence(self, spread: float) -> float:
        """The probability that the factor is right to 2 percent, if the motion is right.

        `spread` is how far apart, in the log of the factor, refinements end that start from smaller
        and larger factors.
        """
        sure = _BIAS + _SPREAD * math.log10(max(spread, _LEAST_SPREAD))
        sure += _SLACK * math.log(max(self.slack, _LEAST_SLACK) / _USUAL_SLACK)
        return 1 / (1 + math.exp(-max(-30.0, min(sure, 30.0))))

    def changed(self, found: Similarity, times: float) -> Similarity:
        """The similarity with another factor, and with the motion that fits it best."""
        return similarity.moved_by(found, math.log(times) * self.step, self.center)


def certainty(source: HostSurface, target: HostSurface, found: Similarity, cut: float) -> Certainty:
    """The certainty of the factor of `found`, from the pairs of points closer than `cut`.

    The rigid motion that gives way most minimizes the distances to the tangent planes (the Schur
    complement of the normal equations). Nothing is certain without pairs: the slack is infinite.
    """
    pairs = similarity.both_ways(source, target, found)
    near = pairs.away <= cut
    count = int(np.count_nonzero(near))
    center = pairs.points.mean(axis=0)
    if count < similarity.FEWEST:
        return Certainty(0.0, math.inf, math.inf, np.eye(7)[6], center)
    system, _ = similarity.equations(pairs, near.astype(np.float64), center)
    rigid = -np.linalg.solve(system[:6, :6], system[:6, 6])
    lever = math.sqrt(max(system[6, 6] + system[6, :6] @ rigid, 0.0) / count)
    off = ((pairs.points - pairs.places) * pairs.normals).sum(axis=1)[near]
    slack = math.sqrt(np.mean(off**2)) / max(lever, 1e-9)
    return Certainty(lever, slack, slack / math.sqrt(count), np.append(rigid, 1.0), center)
