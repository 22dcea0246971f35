"""The loss that training minimizes, for one pair of clouds; batches map over it."""

from __future__ import annotations

from collections.abc import Iterable

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from cfr_jax.geometry import rigid
from cfr_jax.networks.inputs import Cloud
from cfr_jax.networks.record import Goal, Motion, Step

_DISCOUNT = 0.5  # the last iteration counts fully, each earlier one half as much as the next
_INLIER_WEIGHT = 0.01
# Soft targets of the correspondence term (docs/training.md), in radii of the unit sphere. With this
# term, training was measured to learn faster than with the pose alone.
_SPREAD = 0.035
_REACH = 0.1


@struct.dataclass
class PairLoss:
    """The loss of a pair, its parts, and the errors that people read."""

    total: Float[Array, ""]
    pose: Float[Array, ""]
    correspondence: Float[Array, ""]
    rotation_error: Float[Array, " L"]
    """Degrees, per iteration."""
    translation_error: Float[Array, " L"]
    beta: Float[Array, " L"]
    """Of the annealing, as alpha; zero for a network that has none."""
    alpha: Float[Array, " L"]


def pair_loss(
    steps: Iterable[Step | Motion],
    source: Cloud,
    target: Cloud,
    truth: Float[Array, "4 4"],
    *,
    correspondence_weight: float,
) -> PairLoss:
    """The paper's loss for the `steps` of a network, plus a term for the correspondences.

    Pose: the mean of |T_i x - T_truth x| over points and axes, plus 0.01 times the mean slack of
    both clouds, discounted by 0.5 for each iteration before the last. Correspondence: see
    `correspondence_loss`, with the same discount. It stores the affinities, whatever the form of
    the match. `truth` maps source onto target. Raises ValueError for steps without correspondences.
    """
    matched = [_matched(step) for step in steps]
    there = rigid.apply(truth, source.points)
    spread = _squared_distances(there, target.points)
    pose = correspondence = jnp.zeros((), there.dtype)
    for i, step in enumerate(matched):
        discount = _DISCOUNT ** (len(matched) - 1 - i)
        pose += discount * _pose_term(step, source.points, there)
        if correspondence_weight:
            correspondence += discount * correspondence_loss(step.affinity.log(), spread)
    transforms = jnp.stack([step.transform for step in matched])
    return PairLoss(
        total=pose + correspondence_weight * correspondence,
        pose=pose,
        correspondence=correspondence,
        rotation_error=jax.vmap(rigid.rotation_error, (0, None))(transforms, truth),
        translation_error=jax.vmap(rigid.translation_error, (0, None))(transforms, truth),
        beta=jnp.stack([step.affinity.beta for step in matched]),
        alpha=jnp.stack([step.affinity.alpha for step in matched]),
    )


def goal_loss(goal: Goal, truth: Float[Array, "4 4"]) -> PairLoss:
    """What a network with an objective of its own made of a pair, in the same words."""
    nothing = jnp.zeros(len(goal.transforms), goal.loss.dtype)
    return PairLoss(
        total=goal.loss,
        pose=goal.loss,
        correspondence=jnp.zeros_like(goal.loss),
        rotation_error=jax.vmap(rigid.rotation_error, (0, None))(goal.transforms, truth),
        translation_error=jax.vmap(rigid.translation_error, (0, None))(goal.transforms, truth),
        beta=nothing,
        alpha=nothing,
    )


def _matched(step: Step | Motion) -> Step:
    if isinstance(step, Motion):
        raise ValueError("steps: got motions alone, wanted correspondences, or an objective")
    return step


def _pose_term(step: Step, points: Array, there: Array) -> Array:
    distance = jnp.mean(jnp.abs(rigid.apply(step.transform, points) - there))
    slack = jnp.mean(1 - step.match.covered) + jnp.mean(1 - step.match.weights)
    return distance + _INLIER_WEIGHT * slack


def correspondence_loss(
    log_affinity: Float[Array, "n m"], squared_distance: Float[Array, "n m"]
) -> Float[Array, ""]:
    """Cross-entropy between soft targets and the affinities of each row and column, with slack.

    `squared_distance` is between the points after the true motion. A partner at distance d has the
    closeness exp(-d^2 / (2 sigma^2)), sigma = 0.035, and zero from d = 0.1 on. All partners of a
    point together get the closeness of the nearest one as their target, in proportion to their own;
    the slack gets the rest.
    """
    close = jnp.exp(squared_distance / (-2 * _SPREAD**2))
    close = jnp.where(squared_distance < _REACH**2, close, 0)
    of_columns, of_rows = (_cross_entropy(log_affinity, close, axis) for axis in (0, 1))
    return 0.5 * (of_columns + of_rows)


def _cross_entropy(log_affinity: Array, close: Array, axis: int) -> Array:
    found = jnp.max(close, axis=axis)
    share = found / jnp.maximum(jnp.sum(close, axis=axis), 1e-12)
    # the slack's logit is 0
    top = jax.lax.stop_gradient(jnp.maximum(jnp.max(log_affinity, axis=axis, keepdims=True), 0))
    normalizer = jnp.sum(jnp.exp(log_affinity - top), axis=axis) + jnp.exp(-top.squeeze(axis))
    log_normalizer = jnp.log(normalizer) + top.squeeze(axis)
    return jnp.mean(log_normalizer - share * jnp.sum(close * log_affinity, axis=axis))


def _squared_distances(a: Array, b: Array) -> Array:
    x, y, z = ((a[:, axis, None] - b[None, :, axis]) ** 2 for axis in range(3))
    return x + y + z
