"""Clues from the network alone about its answer, and the probability that the answer is right.

Right means within 5 degrees and a tenth of the unit sphere's radius. The probability is a logistic
regression on the clues; its coefficients come with the weights (`networks.probability`).
"""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float

from cfr_jax.geometry import rigid
from cfr_jax.networks.probability import SURE, Calibration, logit
from cfr_jax.runtime.values import ByValue

_HIGHEST = lax.Precision.HIGHEST
_SMALLEST, _LARGEST = 0.2, 1.5  # root mean square radii of clouds of about unit size, and no other


@struct.dataclass(eq=False)
class NetworkClues(ByValue):
    """What the network alone knows about its answer; each clue is of order one."""

    source_found: Float[Array, ""]
    """Mean correspondence weight of the source."""
    target_found: Float[Array, ""]
    """Mean correspondence weight of the target."""
    settled: Float[Array, ""]
    """How far the last iteration still rotated: log of degrees + 0.1."""
    settling: Float[Array, ""]
    """The same for the iteration before."""
    residual: Float[Array, ""]
    """Distance between the matched positions and where the answer puts the points: log of the
    weighted root mean square + 0.01."""
    sharpness: Float[Array, ""]
    """Log of the spread of the matched positions over the spread of their points. If a match is
    undecided among many points, its position is their middle, and the spread shrinks."""
    lever: Float[Array, ""]
    """Log of the spread about the axis around which the rotation is held the least: the
    conditioning of the fit."""


def of_network(
    transforms: Float[Array, "L 4 4"],
    source: Float[Array, "n 3"],
    targets: Float[Array, "n 3"],
    weights: Float[Array, " n"],
    covered: Float[Array, " m"],
    source_mask: Bool[Array, " n"] | None = None,
    target_mask: Bool[Array, " m"] | None = None,
) -> NetworkClues:
    """The clues from the `transforms` of all iterations and from the last match.

    `targets` is where the match puts the points of the source; `weights` and `covered` are how much
    of each source and target point found a partner.
    """
    share = weights / (jnp.sum(weights) + 1e-5)
    away = rigid.apply(transforms[-1], source) - targets
    square = jnp.sum(share * jnp.sum(away * away, axis=1))
    places, points = (_spread(cloud, share) for cloud in (targets, source))
    spread, before_it = jnp.trace(places), jnp.trace(points)
    # nearly the sum of the two smaller eigenvalues; exactly so for points on a line
    twice = spread * spread - jnp.sum(places * places)
    lever = twice / (2 * spread + 1e-4)
    # a single iteration has no predecessor, and counts as settled
    earlier, before, last = (transforms[max(len(transforms) - back, 0)] for back in (3, 2, 1))
    return NetworkClues(
        source_found=_mean(weights, source_mask),
        target_found=_mean(covered, target_mask),
        settled=turned(before, last),
        settling=turned(earlier, before),
        residual=jnp.log(square + 1e-4) / 2,
        sharpness=jnp.log((spread + 1e-4) / (before_it + 1e-4)) / 2,
        lever=jnp.log(lever + 1e-4) / 2,
    )


def of_registration(
    fitted: Calibration | None, clues: NetworkClues, size: Float[Array, ""] | None = None
) -> Float[Array, ""] | None:
    """Probability in [0, 1] that the network's own answer is right; None without a calibration.

    The network and the calibration know clouds of unit size. The further the `size` of the larger
    cloud (`root_mean_square`) lies from theirs, the less is believed: half at 0.1 and at 3.
    """
    if fitted is None:
        return None
    sure = logit(fitted.register, vars(clues))
    told = 1 / (1 + jnp.exp(-jnp.clip(sure, -SURE, SURE)))
    if size is None:
        return told
    return jnp.minimum(told, jnp.minimum(size / _SMALLEST, _LARGEST / jnp.maximum(size, _SMALLEST)))


def root_mean_square(
    points: Float[Array, "n 3"], mask: Bool[Array, " n"] | None = None
) -> Float[Array, ""]:
    """Distance of the points from their centroid, in the root mean square. About 0.5 for clouds in
    the unit sphere."""
    center = jnp.stack([_mean(points[:, axis], mask) for axis in range(3)])
    # a tiny number, so that points in one place have a finite slope
    return jnp.sqrt(_mean(jnp.sum((points - center) ** 2, axis=1), mask) + 1e-12)


def _mean(values: Array, mask: Array | None) -> Array:
    if mask is None:
        return jnp.mean(values)
    valid = mask.astype(values.dtype)
    return jnp.sum(values * valid) / jnp.maximum(jnp.sum(valid), 1)


def turned(first: Float[Array, "4 4"], second: Float[Array, "4 4"]) -> Float[Array, ""]:
    """Log of the angle between two rotations in degrees + 0.1.

    Its slope stays bounded if the rotations are equal or half a turn apart.
    """
    chord = jnp.sum((first[:3, :3] - second[:3, :3]) ** 2)
    half_sine = jnp.minimum(jnp.sqrt(chord / 8 + 1e-12), 1 - 1e-6)
    return jnp.log(jnp.rad2deg(2 * jnp.arcsin(half_sine)) + 0.1)


def _spread(points: Array, share: Array) -> Array:
    """Weighted covariance of points."""
    center = jnp.matmul(share, points, precision=_HIGHEST)
    offset = points - center
    return jnp.matmul(offset.T, share[:, None] * offset, precision=_HIGHEST)
