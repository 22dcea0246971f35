"""`Affinity`, what is matched, and `Match`, the result."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float

EPSILON = 1e-5  # added to the row sum that a target is divided by


@struct.dataclass
class Affinity:
    """log m_ij = -beta (|f_i - g_j|^2 - alpha) for unit features f and g, not yet evaluated.

    It holds n + m rows; evaluated it would be n m numbers.
    """

    source: Float[Array, "n d"]
    target: Float[Array, "m d"]
    beta: Float[Array, ""]
    alpha: Float[Array, ""]

    def log(self) -> Float[Array, "n m"]:
        """The evaluated block."""
        return log_affinity(squared_distances(self.source, self.target), self.beta, self.alpha)


class Match(NamedTuple):
    """Soft correspondence of n source points with m target points."""

    weights: Float[Array, " n"]
    """Row sums: how much of each source point found a partner, in [0, 1]."""
    targets: Float[Array, "n 3"]
    """The weighted mean of its partners."""
    covered: Float[Array, " m"]
    """Column sums: how much of each target point was found."""


class Trace(NamedTuple):
    """What the hand-written gradients need from the forward direction: the scalings of p passes."""

    u: Float[Array, "p n"]
    """Scalings of the rows, after each pass."""
    v_before: Float[Array, "p m"]
    """Scalings of the columns, before each pass."""
    v: Float[Array, " m"]
    """Scalings of the columns, after the last pass."""
    shift: Float[Array, " n"]
    sums: Float[Array, "n 4"]


def squared_distances(
    source: Float[Array, "n d"], target: Float[Array, "m d"]
) -> Float[Array, "n m"]:
    """|f_i - g_j|^2 of unit rows, by one product.

    At full precision, because the exponent of the affinity multiplies the error by beta.
    """
    return 2 - 2 * jnp.matmul(source, target.T, precision=lax.Precision.HIGHEST)


def log_affinity(square: Float[Array, "n m"], beta: Array, alpha: Array) -> Float[Array, "n m"]:
    """-beta (d^2 - alpha)."""
    return -beta * (square - alpha)


def masked(
    log_values: Float[Array, "n m"],
    source_mask: Bool[Array, " n"] | None,
    target_mask: Bool[Array, " m"] | None,
) -> Float[Array, "n m"]:
    """Log affinities with masked rows and columns set to minus infinity."""
    if source_mask is not None:
        log_values = jnp.where(source_mask[:, None], log_values, -jnp.inf)
    if target_mask is not None:
        log_values = jnp.where(target_mask, log_values, -jnp.inf)
    return log_values


def match_of(sums: Float[Array, "n 4"], covered: Float[Array, " m"]) -> Match:
    """A match from each row's sum of weighted targets (3) and of weights (1)."""
    weights = sums[:, 3]
    return Match(weights, sums[:, :3] / (weights + EPSILON)[:, None], covered)


def gradient_of_sums(gradient: Match, sums: Float[Array, "n 4"]) -> Float[Array, "n 4"]:
    """The gradient of `match_of` with respect to its sums."""
    inverse = 1 / (sums[:, 3:] + EPSILON)
    of_points = gradient.targets * inverse
    of_weights = gradient.weights - jnp.sum(of_points * sums[:, :3] * inverse, axis=1)
    return jnp.concatenate([of_points, of_weights[:, None]], axis=1)


def gradient_of_scaling(u: Float[Array, " n"], of_u: Float[Array, " n"]) -> Float[Array, " n"]:
    """The gradient of u = 1 / max(sum, tiny) with respect to the sum; zero at the floor."""
    return jnp.where(u * jnp.finfo(u.dtype).tiny < 1, -u * (u * of_u), 0)


def with_ones(points: Float[Array, "m 3"]) -> Float[Array, "m 4"]:
    """Points with a column of ones, so that one product sums both targets and weights."""
    return jnp.pad(points, ((0, 0), (0, 1)), constant_values=1)
