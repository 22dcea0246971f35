"""Optimizers and learning rates, by the names that configs use."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
import optax.contrib
from jax.typing import ArrayLike
from jaxtyping import Array, Int, PyTree

from cfr_jax.networks.peers.batch_norm import MOMENTUM, is_running

SCHEDULES = ("cosine", "wsd", "constant", "trapezoid", "stairs")
OPTIMIZERS = ("adamw", "adam", "lion", "sgd", "muon")

# "muon" orthogonalizes matrices whose smaller side is in this range. Smaller ones are inputs and
# outputs of a network; for larger ones it would cost a tenth of a training step.
_HIDDEN = range(32, 129)


@dataclasses.dataclass(frozen=True)
class Trapezoid:
    """A learning rate that rises from zero, stays at its peak, and falls to zero, all linearly.

    `warmup` and `cooldown` are shares of all steps. The number of steps is not part of the compiled
    program: an optimizer made with this schedule keeps it in its state (`planned`), so it can be
    decided after the speed of a step is known.
    """

    peak_rate: float
    steps: int
    warmup: float
    cooldown: float

    def __call__(self, count: ArrayLike) -> Array:
        """The rate of step `count`, from 0."""
        return self.at(count, self.steps)

    def at(self, count: ArrayLike, steps: ArrayLike) -> Array:
        """The rate of step `count` in a training of `steps` steps."""
        done, steps = jnp.asarray(count, jnp.float32), jnp.asarray(steps, jnp.float32)
        risen = (done + 1) / jnp.maximum(self.warmup * steps, 1)
        left = (steps - done) / jnp.maximum(self.cooldown * steps, 1)
        return self.peak_rate * jnp.clip(jnp.minimum(risen, left), 0, 1)


@dataclasses.dataclass(frozen=True)
class Stairs:
    """A rate that becomes `factor` of itself at each of the `drops`, shares of all steps; planned
    as a `Trapezoid`."""

    peak_rate: float
    steps: int
    drops: tuple[float, ...]
    factor: float

    def __call__(self, count: ArrayLike) -> Array:
        """The rate of step `count`, from 0."""
        return self.at(count, self.steps)

    def at(self, count: ArrayLike, steps: ArrayLike) -> Array:
        """The same in a training of so many steps."""
        done, steps = jnp.asarray(count, jnp.float32), jnp.asarray(steps, jnp.float32)
        fallen = sum((done >= jnp.round(drop * steps)).astype(jnp.float32) for drop in self.drops)
        return self.peak_rate * jnp.float32(self.factor) ** fallen


class Planned(NamedTuple):
    """The current step of an optimizer, and the number of steps of its training."""

    # optax finds the step by this name, which hides a method of tuples
    count: Int[Array, ""]  # type: ignore[assignment]
    planned_steps: Int[Array, ""]


def planned(state: optax.OptState, steps: Int[Array, ""]) -> optax.OptState:
    """An optimizer's state for a training of `steps` steps; unchanged unless its schedule is a
    `Trapezoid` or `Stairs`."""
    if optax.tree.get(state, "planned_steps") is None:
        return state
    return optax.tree.set(state, planned_steps=steps)


def make_schedule(
    kind: str,
    *,
    peak_rate: float,
    steps: int,
    warmup: float,
    cooldown: float = 0.2,
    drops: tuple[float, ...] = (),
    factor: float = 0.1,
) -> optax.Schedule:
    """The learning rate over `steps` steps; `warmup` and `cooldown` are shares of them.

    "cosine", "wsd" and "constant" start at a 25th of the peak and rise during the warmup. Then
    "cosine" falls along half a wave to a thousandth of the peak. "wsd" (warmup, stable, decay)
    stays at the peak until the cooldown and falls linearly to a thousandth, so that a run can be
    extended without starting over. "constant" stays at the peak. "trapezoid" is a `Trapezoid`,
    "stairs" is `Stairs`.
    Raises ValueError for an unknown name and for numbers that cannot be used.
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
    if kind == "stairs":
        if not (all(0 < drop < 1 for drop in drops) and 0 < factor <= 1):
            raise ValueError(
                f"schedule: got drops {drops} to {factor}, wanted shares of all steps, and of the "
                "rate"
            )
        return Stairs(peak_rate, steps, drops, factor)
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
    """An optimizer, after the gradient is clipped by its global norm.

    "adamw", "lion" and "sgd" (Nesterov momentum 0.9) use decoupled weight decay. "muon" (Jordan,
    2024) orthogonalizes the momentum of hidden matrices, each matrix of a stack by itself, and
    scales it so that AdamW's rates suit it (Liu et al., 2025); all other weights use AdamW with
    Nesterov momentum. "adam" adds `weight_decay` times the weights to the gradient first, as the
    published trainings did. Raises ValueError for an unknown name.
    """
    if isinstance(schedule, Trapezoid | Stairs):
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


def keep_running(optimizer: optax.GradientTransformation) -> optax.GradientTransformation:
    """The optimizer for all but the running statistics of batch norms (`peers.batch_norm`), which
    follow those of the batches: by gradient descent at the published rate."""

    def kinds(params: PyTree) -> PyTree:
        return jax.tree.map_with_path(
            lambda path, _: "running" if is_running(path) else "learned", params
        )

    return optax.partition({"learned": optimizer, "running": optax.sgd(MOMENTUM)}, kinds)


def _scaled_by(schedule: Trapezoid | Stairs) -> optax.GradientTransformation:
    def init(params: PyTree) -> Planned:
        return Planned(jnp.zeros((), jnp.int32), jnp.asarray(schedule.steps, jnp.int32))

    def update(updates: PyTree, state: Planned, params: PyTree = None) -> tuple[PyTree, Planned]:
        rate = schedule.at(state.count, state.planned_steps)
        updates = jax.tree.map(lambda leaf: rate * leaf, updates)
        return updates, Planned(state.count + 1, state.planned_steps)

    return optax.GradientTransformation(init, update)


def _hidden_matrices(params: PyTree) -> PyTree:
    """For each leaf, the axes of a hidden matrix's inputs and outputs, or None if it is not one."""

    def axes(leaf: Array) -> optax.contrib.MuonDimensionNumbers | None:
        if leaf.ndim < 2 or min(leaf.shape[-2:]) not in _HIDDEN:
            return None
        return optax.contrib.MuonDimensionNumbers(leaf.ndim - 2, leaf.ndim - 1)

    return jax.tree.map(axes, params)
