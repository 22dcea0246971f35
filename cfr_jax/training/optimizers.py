"""Optimizers and learning rates by name, as a config asks for them."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
import optax.contrib
from jax.typing import ArrayLike
from jaxtyping import Array, Int, PyTree

SCHEDULES = ("cosine", "wsd", "constant", "trapezoid")
OPTIMIZERS = ("adamw", "adam", "lion", "sgd", "muon")

# Smaller sides of the matrices that "muon" turns: below, they are a network's inputs and outputs;
# above, orthogonalizing costs a tenth of a training step.
_HIDDEN = range(32, 129)


@dataclasses.dataclass(frozen=True)
class Trapezoid:
    """A rate that rises from zero over the warm-up, stays, and falls to zero over the cooldown, in
    straight lines; both are shares of all steps.

    The number of steps is no part of the compiled program: an optimizer made with this keeps it in
    its state (`planned`), so it may be decided once the speed of a step is known.
    """

    peak_rate: float
    steps: int
    warmup: float
    cooldown: float

    def __call__(self, count: ArrayLike) -> Array:
        """The rate of step `count`, from 0."""
        return self.at(count, self.steps)

    def at(self, count: ArrayLike, steps: ArrayLike) -> Array:
        """The same in a training of so many steps."""
        done, steps = jnp.asarray(count, jnp.float32), jnp.asarray(steps, jnp.float32)
        risen = (done + 1) / jnp.maximum(self.warmup * steps, 1)
        left = (steps - done) / jnp.maximum(self.cooldown * steps, 1)
        return self.peak_rate * jnp.clip(jnp.minimum(risen, left), 0, 1)


class Planned(NamedTuple):
    """Where in a training of how many steps an optimizer is."""

    # optax finds the step by this name, which hides a method of tuples
    count: Int[Array, ""]  # type: ignore[assignment]
    planned_steps: Int[Array, ""]


def planned(state: optax.OptState, steps: Int[Array, ""]) -> optax.OptState:
    """An optimizer's state in a training of `steps` steps; the same where its schedule is not a
    `Trapezoid`."""
    if optax.tree.get(state, "planned_steps") is None:
        return state
    return optax.tree.set(state, planned_steps=steps)


def make_schedule(
    kind: str, *, peak_rate: float, steps: int, warmup: float, cooldown: float = 0.2
) -> optax.Schedule:
    """The learning rate over `steps` steps; `warmup` and `cooldown` are shares of them.

    All but the last start at a 25th of the peak and rise over the warm-up. Then "cosine" falls to a
    thousandth along half a wave; "wsd" (warm-up, stable, decay) stays until the cool-down and falls
    to a thousandth in a straight line, so that a run can be made longer without starting anew;
    "constant" stays. "trapezoid" is a `Trapezoid`.
    """
    if not steps > 0 or not peak_rate > 0:
        raise ValueError(f"schedule: got {steps} steps at {peak_rate}, wanted both positive")
    if not 0 <= warmup < 1 or not 0 < cooldown <= 1 - warmup:
        raise ValueError(
            f"schedule: got warmup {warmup} and cooldown {cooldown}, wanted shares of all steps, "
            "together at most 1"
        )
    if kind == "trapezoid":
        return Trapezoid(peak_rate, steps, warmup, cooldown)
    rising = max(1, int(warmup * steps))
    start, end = peak_rate / 25, peak_rate / 1000
    if kind == "cosine":
        return optax.warmup_cosine_decay_schedule(start, peak_rate, rising, steps, end)
    rise = optax.linear_schedule(start, peak_rate, rising)
    stay = optax.constant_schedule(peak_rate)
    if kind == "constant":
        return optax.join_schedules([rise, stay], [rising])
    if kind == "wsd":
        falling = max(1, int(cooldown * steps))
        fall = optax.linear_schedule(peak_rate, end, falling)
        return optax.join_schedules([rise, stay, fall], [rising, max(rising, steps - falling)])
    raise ValueError(f"schedule: got {kind!r}, wanted one of {', '.join(SCHEDULES)}")


def make_optimizer(
    kind: str, schedule: optax.Schedule, *, clip: float, weight_decay: float
) -> optax.GradientTransformation:
    """An optimizer behind a gradient clipped by global norm.

    "adamw", "lion" and "sgd" (Nesterov momentum 0.9) shrink the weights apart from the gradient.
    "muon" (Jordan, 2024) orthogonalizes the momentum of hidden matrices, stacked ones each by
    itself, scaled so that AdamW's rates suit it (Liu et al., 2025), and is AdamW with Nesterov's
    momentum for the rest. "adam" adds `weight_decay` times the weights to the gradient first, as
    the published trainings did.
    """
    if isinstance(schedule, Trapezoid):
        return optax.chain(
            make_optimizer(kind, _one, clip=clip, weight_decay=weight_decay),
            _scaled_by(schedule),
        )
    if kind == "adamw":
        rule = optax.adamw(schedule, weight_decay=weight_decay)
    elif kind == "adam":
        rule = optax.chain(optax.add_decayed_weights(weight_decay), optax.adam(schedule))
    elif kind == "lion":
        rule = optax.lion(schedule, weight_decay=weight_decay)
    elif kind == "sgd":
        rule = optax.chain(
            optax.trace(0.9, nesterov=True),
            optax.add_decayed_weights(weight_decay),
            optax.scale_by_learning_rate(schedule),
        )
    elif kind == "muon":
        rule = optax.contrib.muon(
            schedule,
            weight_decay=weight_decay,
            adam_weight_decay=weight_decay,
            muon_weight_dimension_numbers=_hidden_matrices,
            consistent_rms=0.2,
        )
    else:
        raise ValueError(f"optimizer: got {kind!r}, wanted one of {', '.join(OPTIMIZERS)}")
    return optax.chain(optax.clip_by_global_norm(clip), rule)


def _one(count: ArrayLike) -> Array:
    return jnp.ones((), jnp.float32)


def _scaled_by(schedule: Trapezoid) -> optax.GradientTransformation:
    def init(params: PyTree) -> Planned:
        return Planned(jnp.zeros((), jnp.int32), jnp.asarray(schedule.steps, jnp.int32))

    def update(updates: PyTree, state: Planned, params: PyTree = None) -> tuple[PyTree, Planned]:
        rate = schedule.at(state.count, state.planned_steps)
        updates = jax.tree.map(lambda leaf: rate * leaf, updates)
        return updates, Planned(state.count + 1, state.planned_steps)

    return optax.GradientTransformation(init, update)


def _hidden_matrices(params: PyTree) -> PyTree:
    """Which axes of a leaf are a hidden matrix's inputs and outputs, or None."""

    def axes(leaf: Array) -> optax.contrib.MuonDimensionNumbers | None:
        if leaf.ndim < 2 or min(leaf.shape[-2:]) not in _HIDDEN:
            return None
        return optax.contrib.MuonDimensionNumbers(leaf.ndim - 2, leaf.ndim - 1)

    return jax.tree.map(axes, params)
