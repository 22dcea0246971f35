"""What is matched, and what a match is."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float

EPSILON = 1e-5  # in the quotient that makes a target of the sums


@struct.dataclass
class Affinity:
    """log m_ij = -beta (|f_i - g_j|^2 - alpha) of unit features f and g, kept unevaluated: it is
    n + m rows, where its values are n m numbers."""

    source: Float[Array, "n d"]
    target: Float[Array, "m d"]
    beta: Float[Array, ""]
    alpha: Float[Array, ""]

    def log(self) -> Float[Array, "n m"]:
        """Its values."""
        return log_affinity(squared_distances(self.source, self.target), self.beta, self.alpha)


class Match(NamedTuple):
    """Soft correspondence of n source points with m target points."""

    weights: Float[Array, " n"]
    """Row sums: how much of each source point found a partner, in [0, 1]."""
    targets: Float[Array, "n 3"]
    """Where its partners are, on average."""
    covered: Float[Array, " m"]
    """Column sums: how much of each target point was found."""


class Trace(NamedTuple):
    """What the gradients written by hand need of the values: the scalings of p passes."""

    u: Float[Array, "p n"]
    """Of the rows, after each pass."""
    v_before: Float[Array, "p m"]
    """Of the columns, before each pass."""
    v: Float[Array, " m"]
    """Of the columns, after the last."""
    shift: Float[Array, " n"]
    sums: Float[Array, "n 4"]


def squared_distances(
    source: Float[Array, "n d"], target: Float[Array, "m d"]
) -> Float[Array, "n m"]:
    """|f_i - g_j|^2 of unit rows, by one product at full precision: the affinity's exponent
    multiplies its error by beta."""
    return 2 - 2 * jnp.matmul(source, target.T, precision=lax.Precision.HIGHEST)


def log_affinity(square: Float[Array, "n m"], beta: Array, alpha: Array) -> Float[Array, "n m"]:
    """-beta (d^2 - alpha)."""
    return -beta * (square - alpha)


def masked(
    log_values: Float[Array, "n m"],
    source_mask: Bool[Array, " n"] | None,
    target_mask: Bool[Array, " m"] | None,
) -> Float[Array, "n m"]:
    """Log affinities with masked rows and columns at minus infinity."""
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
    """`match_of` backwards."""
    inverse = 1 / (sums[:, 3:] + EPSILON)
    of_points = gradient.targets * inverse
    of_weights = gradient.weights - jnp.sum(of_points * sums[:, :3] * inverse, axis=1)
    return jnp.concatenate([of_points, of_weights[:, None]], axis=1)


def gradient_of_scaling(u: Float[Array, " n"], of_u: Float[Array, " n"]) -> Float[Array, " n"]:
    """u = 1 / max(sum, tiny) backwards; where the floor was reached, nothing depends on the row."""
    return jnp.where(u * jnp.finfo(u.dtype).tiny < 1, -u * (u * of_u), 0)


def with_ones(points: Float[Array, "m 3"]) -> Float[Array, "m 4"]:
    """Points and a one, so that one product sums the targets and the weights."""
    return jnp.pad(points, ((0, 0), (0, 1)), constant_values=1)
