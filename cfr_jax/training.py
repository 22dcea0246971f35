"""Training: the state, one pure step, and what stands between two steps."""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Iterator

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Int

from cfr_jax.losses import PairLoss, pair_loss
from cfr_jax.normals import estimate_normals
from cfr_jax.registration import Cloud, Step

Unroll = Callable[[dict, Cloud, Cloud, Hashable], Iterator[Step]]
"""The iterations of a network on a pair: `registration.unroll`, or `rpmnet.unroll`."""


@struct.dataclass
class TrainState:
    """All that a step changes."""

    step: Int[Array, ""]
    params: dict
    average: dict
    """Exponential moving average of the parameters: what is validated and shipped."""
    optimizer: optax.OptState
    skipped: Int[Array, ""]
    """Steps left out because their gradient was not finite."""


def make_optimizer(
    *, peak_rate: float, steps: int, warmup: float, clip: float, weight_decay: float
) -> optax.GradientTransformation:
    """AdamW under a one-cycle learning rate, its gradient clipped by global norm."""
    schedule = optax.warmup_cosine_decay_schedule(
        init_value=peak_rate / 25,
        peak_value=peak_rate,
        warmup_steps=max(1, int(warmup * steps)),
        decay_steps=steps,
        end_value=peak_rate / 1000,
    )
    return optax.chain(
        optax.clip_by_global_norm(clip), optax.adamw(schedule, weight_decay=weight_decay)
    )


def init_state(params: dict, optimizer: optax.GradientTransformation) -> TrainState:
    """A state at step zero; the average starts as a copy, since the step donates both."""
    return TrainState(
        step=jnp.zeros((), jnp.int32),
        params=params,
        average=jax.tree.map(jnp.copy, params),
        optimizer=optimizer.init(params),
        skipped=jnp.zeros((), jnp.int32),
    )


@functools.partial(
    jax.jit,
    static_argnames=(
        "unroll",
        "optimizer",
        "settings",
        "correspondence_weight",
        "decay",
        "pairs_at_once",
    ),
    donate_argnames=("state",),
)
def train_step(
    state: TrainState,
    batch: dict,
    *,
    unroll: Unroll,
    settings: Hashable,
    optimizer: optax.GradientTransformation,
    correspondence_weight: float,
    decay: float,
    pairs_at_once: int,
) -> tuple[TrainState, PairLoss]:
    """One step on a batch of `data.batches`; losses come back averaged over its pairs.

    `pairs_at_once` pairs are vectorized, the rest follow one another: on CPU one at a time keeps
    the activations in cache and is fastest, an accelerator wants the whole batch. A step whose
    gradient is not finite changes nothing but `skipped`.
    """

    def loss(params, pair):
        source, target = (_cloud(pair, side) for side in ("source", "target"))
        measured = pair_loss(
            unroll(params, source, target, settings),
            source,
            target,
            pair["transform"],
            correspondence_weight=correspondence_weight,
        )
        return measured.total, measured

    gradient_of = jax.grad(loss, has_aux=True)

    def add(total, pairs):
        if pairs_at_once == 1:  # a batch axis of one would send XLA's products down a slower path
            every = gradient_of(state.params, jax.tree.map(lambda leaf: leaf[0], pairs))
        else:
            every = jax.vmap(gradient_of, (None, 0))(state.params, pairs)
            every = jax.tree.map(lambda leaf: leaf.sum(0), every)
        return jax.tree.map(jnp.add, total, every), None

    # Gradients are summed as they come: a map differentiated as a whole would keep the activations
    # of all its pairs.
    size = len(batch["transform"])
    chunks = jax.tree.map(lambda leaf: leaf.reshape(-1, pairs_at_once, *leaf.shape[1:]), batch)
    one = jax.tree.map(lambda leaf: leaf[0], batch)
    zeros = jax.eval_shape(gradient_of, state.params, one)
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), zeros)
    total, _ = jax.lax.scan(add, zeros, chunks)
    gradient, measured = jax.tree.map(lambda leaf: leaf / size, total)
    sound = jnp.isfinite(optax.tree.norm(gradient))
    gradient = jax.tree.map(lambda leaf: jnp.where(sound, leaf, 0), gradient)
    updates, moments = optimizer.update(gradient, state.optimizer, state.params)
    params = optax.apply_updates(state.params, updates)
    # early in a run a long average would still be the initial weights
    decay = jnp.minimum(decay, (1 + state.step) / (10 + state.step))
    average = jax.tree.map(lambda a, p: a + (1 - decay) * (p - a), state.average, params)

    def keep(new, old):
        return jax.tree.map(lambda n, o: jnp.where(sound, n, o), new, old)

    after = TrainState(
        step=state.step + 1,
        params=keep(params, state.params),
        average=keep(average, state.average),
        optimizer=keep(moments, state.optimizer),
        skipped=state.skipped + (1 - sound),
    )
    return after, measured


def _cloud(pair, side):
    points, neighbors = pair[side], pair[f"{side}_neighbors"]
    normals = jnp.where(
        pair["estimate_normals"], estimate_normals(points, neighbors), pair[f"{side}_normals"]
    )
    return Cloud(points, normals, neighbors)


@functools.partial(jax.jit, static_argnames=("unroll", "settings"))
def predict(params: dict, batch: dict, *, unroll: Unroll, settings: Hashable) -> Array:
    """Transforms (b, L, 4, 4) of a batch that needs no training, pair after pair."""

    def of_pair(pair):
        source, target = (_cloud(pair, side) for side in ("source", "target"))
        return jnp.stack([step.transform for step in unroll(params, source, target, settings)])

    return jax.lax.map(of_pair, batch)
