"""`Affinity`, what is matched, and `Match`, the result."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float

_HIGHEST = lax.Precision.HIGHEST
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
    return 2 - 2 * _products(source, target)


@jax.custom_jvp  # so that gradients do not pass through the halves
def _products(source: Float[Array, "n d"], target: Float[Array, "m d"]) -> Float[Array, "n m"]:
    if source.dtype != jnp.float32:
        return _at_once(source, target)
    return lax.platform_dependent(source, target, cuda=by_halves, default=_at_once)


@_products.defjvp
def _products_jvp(
    primals: tuple[Array, Array], tangents: tuple[Array, Array]
) -> tuple[Array, Array]:
    (source, target), (of_source, of_target) = primals, tangents
    return _products(source, target), _at_once(of_source, target) + _at_once(source, of_target)


def _at_once(source: Array, target: Array) -> Array:
    return jnp.matmul(source, target.T, precision=_HIGHEST)


def by_halves(source: Float[Array, "n d"], target: Float[Array, "m d"]) -> Float[Array, "n m"]:
    """All inner products, for a GPU whose matrix units round their inputs to eleven bits (TF32).

    They sum in float32. So each number is split into a high and a low half that they do not round.
    High times high, high times low and low times high are one product with three times as many
    columns. What is left out is at most 2^-22 of a product. GPUs older than TF32 multiply the
    halves in float32, which takes them three times as long.
    """
    (high_source, low_source), (high_target, low_target) = _halves(source), _halves(target)
    # the small parts are summed first
    left = jnp.concatenate([low_source, high_source, high_source], axis=1)
    right = jnp.concatenate([high_target, low_target, high_target], axis=1)
    return jnp.matmul(left, right.T, precision=lax.Precision.DEFAULT)


def _halves(rows: Array) -> tuple[Array, Array]:
    high = lax.reduce_precision(rows, exponent_bits=8, mantissa_bits=10)
    return high, lax.reduce_precision(rows - high, exponent_bits=8, mantissa_bits=10)


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
