"""The training step: pure, donated, data-parallel over the devices of a mesh."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Hashable

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Int, Int32, PyTree, UInt32

from cfr_jax.data.augmentation.pairs_on_device import Shapes, draw_pairs
from cfr_jax.data.augmentation.sampling import Sampling
from cfr_jax.geometry.normals import estimate_normals
from cfr_jax.networks.inputs import Cloud
from cfr_jax.networks.peers.batch_norm import PAIRS
from cfr_jax.networks.record import Objective, Params, Unroll
from cfr_jax.training.devices import AXIS
from cfr_jax.training.losses import PairLoss, goal_loss, pair_loss

PRECISIONS = ("float32", "tensorfloat32", "bfloat16")
# The precision of the products in learned layers, that is, of all products whose precision is not
# stated in the program. Distances, covariances, affinities and motions state theirs, and always
# stay float32. With "bfloat16", the activations of the heavy extraction are less precise as well
# (`Settings.activations`). A CPU always multiplies in float32.
_PRODUCTS = {"float32": "float32", "tensorfloat32": "tensorfloat32", "bfloat16": "tensorfloat32"}


@struct.dataclass
class TrainState:
    """Everything that a step changes."""

    step: Int[Array, ""]
    params: Params
    average: Params
    """Exponential moving average of the parameters: what is validated and shipped."""
    optimizer: optax.OptState
    skipped: Int[Array, ""]
    """Number of steps skipped because their gradient was not finite, or after too many of those."""
    skipped_in_row: Int[Array, ""]
    """How many of the latest steps were skipped, without a good one in between."""


@dataclasses.dataclass(frozen=True)
class Recipe:
    """What a step depends on when it is compiled."""

    unroll: Unroll
    settings: Hashable
    optimizer: optax.GradientTransformation
    mesh: Mesh
    correspondence_weight: float
    average_decay: float
    pairs_at_once: int
    precision: str
    max_skipped: int
    """How many steps in a row may be skipped; after more than these, nothing changes anymore."""
    objective: Objective | None = None
    """What is minimized instead of `pair_loss`."""


def init_state(params: Params, optimizer: optax.GradientTransformation) -> TrainState:
    """A state at step zero; the average starts as a copy, since the step donates both."""
    return TrainState(
        step=jnp.zeros((), jnp.int32),
        params=params,
        average=jax.tree.map(jnp.copy, params),
        optimizer=optimizer.init(params),
        skipped=jnp.zeros((), jnp.int32),
        skipped_in_row=jnp.zeros((), jnp.int32),
    )


@functools.partial(jax.jit, static_argnames=("recipe",), donate_argnames=("state",))
def train_step(
    state: TrainState, batch: dict[str, Array], *, recipe: Recipe
) -> tuple[TrainState, PairLoss]:
    """One step on a batch of `data.batches`; also returns losses and errors, pair by pair.

    The pairs are spread evenly over the mesh. Each device accumulates the gradient of its share
    over groups of `pairs_at_once` vectorized pairs, so that any batch fits in memory. On a CPU, one
    at a time keeps the activations in the cache and is fastest; an accelerator wants many. If the
    gradient is not finite, a step only advances the counts of steps and skipped steps. After more
    than `max_skipped` such steps in a row, no further step changes anything else either, so that
    the loop, which checks only now and then, finds that state.
    """
    return _advance(state, batch, recipe)


@functools.partial(jax.jit, static_argnames=("recipe", "sampling"), donate_argnames=("state",))
def train_on_drawn(
    state: TrainState,
    shapes: Shapes,
    seed: UInt32[Array, ""],
    items: Int32[Array, "k b"],
    positions: UInt32[Array, "k b"],
    *,
    recipe: Recipe,
    sampling: Sampling,
) -> tuple[TrainState, PairLoss]:
    """`k` steps at once, each on pairs that the devices draw (`data.augmentation.pairs_on_device`).

    Step i draws pairs of the shapes `items[i]` at the positions `positions[i]` of the stream. Also
    returns the losses of all k b pairs.
    """

    def draw(shapes: Shapes, seed: Array, items: Array, positions: Array) -> dict[str, Array]:
        return draw_pairs(shapes, seed, items, positions, sampling)

    def one(state: TrainState, stretch: tuple[Array, Array]) -> tuple[TrainState, PairLoss]:
        # each device draws its own share
        batch = jax.shard_map(
            draw,
            mesh=recipe.mesh,
            in_specs=(P(), P(), P(AXIS), P(AXIS)),
            out_specs=P(AXIS),
            check_vma=False,
        )(shapes, seed, *stretch)
        return _advance(state, batch, recipe)

    state, measured = jax.lax.scan(one, state, (items, positions))
    return state, jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), measured)


def _advance(
    state: TrainState, batch: dict[str, Array], recipe: Recipe
) -> tuple[TrainState, PairLoss]:
    with jax.default_matmul_precision(_PRODUCTS[recipe.precision]):
        gradient, measured = jax.shard_map(
            functools.partial(_mean_gradient, recipe=recipe),
            mesh=recipe.mesh,
            in_specs=(P(), P(AXIS)),
            out_specs=P(),
            check_vma=False,  # hand-written derivatives do not declare how they vary over devices
        )(state.params, batch)
    lost = state.skipped_in_row > recipe.max_skipped
    sound = jnp.isfinite(optax.tree.norm(gradient)) & ~lost
    gradient = jax.tree.map(lambda leaf: jnp.where(sound, leaf, 0), gradient)
    updates, moments = recipe.optimizer.update(gradient, state.optimizer, state.params)
    params = optax.apply_updates(state.params, updates)
    # early in a run, a long average would still consist of the initial weights
    decay = jnp.minimum(recipe.average_decay, (1 + state.step) / (10 + state.step))
    average = jax.tree.map(lambda a, p: a + (1 - decay) * (p - a), state.average, params)

    def keep(new: PyTree, old: PyTree) -> PyTree:
        return jax.tree.map(lambda n, o: jnp.where(sound, n, o), new, old)

    after = TrainState(
        step=state.step + 1,
        params=keep(params, state.params),
        average=keep(average, state.average),
        optimizer=keep(moments, state.optimizer),
        skipped=state.skipped + (1 - sound),
        skipped_in_row=jnp.where(sound, 0, state.skipped_in_row + 1),
    )
    return after, measured


def _mean_gradient(
    params: Params, batch: dict[str, Array], *, recipe: Recipe
) -> tuple[Params, PairLoss]:
    """The gradient of the mean loss over all devices, from this device's pairs of the batch."""

    def loss(params: Params, pair: dict[str, Array]) -> tuple[Array, PairLoss]:
        source, target = (_cloud(pair, side) for side in ("source", "target"))
        if recipe.objective is not None:
            goal = recipe.objective(params, source, target, pair["transform"], recipe.settings)
            measured = goal_loss(goal, pair["transform"])
            return measured.total, measured
        measured = pair_loss(
            recipe.unroll(params, source, target, recipe.settings),
            source,
            target,
            pair["transform"],
            correspondence_weight=recipe.correspondence_weight,
        )
        return measured.total, measured

    gradient_of = jax.grad(loss, has_aux=True)
    size = len(batch["transform"])
    at_once = min(recipe.pairs_at_once, size)

    def add(total: Params, pairs: dict[str, Array]) -> tuple[Params, PairLoss]:
        # with a batch axis of length one, XLA would choose slower products
        if at_once == 1 and recipe.objective is None:
            gradient, measured = gradient_of(params, jax.tree.map(lambda leaf: leaf[0], pairs))
            measured = jax.tree.map(lambda leaf: leaf[None], measured)
        else:
            gradient, measured = jax.vmap(gradient_of, (None, 0), axis_name=PAIRS)(params, pairs)
            gradient = jax.tree.map(lambda leaf: leaf.sum(0), gradient)
        return jax.tree.map(jnp.add, total, gradient), measured

    # Gradients are summed as they come: differentiating one map over all pairs would keep the
    # activations of all of them.
    chunks = jax.tree.map(lambda leaf: leaf.reshape(-1, at_once, *leaf.shape[1:]), batch)
    total, measured = jax.lax.scan(add, jax.tree.map(jnp.zeros_like, params), chunks)
    measured = jax.tree.map(lambda leaf: leaf.reshape(size, *leaf.shape[2:]), measured)
    count = size * jax.lax.axis_size(AXIS)
    total = jax.lax.psum(total, AXIS)
    measured = jax.lax.all_gather(measured, AXIS, tiled=True)
    return jax.tree.map(lambda leaf: leaf / count, total), measured


def _cloud(pair: dict[str, Array], side: str) -> Cloud:
    points, neighbors = pair[side], pair[f"{side}_neighbors"]
    normals = jnp.where(
        pair["estimate_normals"], estimate_normals(points, neighbors), pair[f"{side}_normals"]
    )
    return Cloud(points, normals, neighbors)


@functools.partial(jax.jit, static_argnames=("unroll", "settings", "mesh", "pairs_at_once"))
def predict(
    params: Params,
    batch: dict[str, Array],
    *,
    unroll: Unroll,
    settings: Hashable,
    mesh: Mesh,
    pairs_at_once: int = 1,
) -> Array:
    """The transforms (b, L, 4, 4) of a batch, without training, in float32.

    Each device takes its share, in groups of `pairs_at_once` vectorized pairs.
    """

    def of_pair(params: Params, pair: dict[str, Array]) -> Array:
        source, target = (_cloud(pair, side) for side in ("source", "target"))
        return jnp.stack([step.transform for step in unroll(params, source, target, settings)])

    def of_share(params: Params, pairs: dict[str, Array]) -> Array:
        size = len(pairs["transform"])
        return jax.lax.map(
            functools.partial(of_pair, params),
            pairs,
            batch_size=None if pairs_at_once == 1 else min(pairs_at_once, size),
        )

    with jax.default_matmul_precision("float32"):
        return jax.shard_map(
            of_share, mesh=mesh, in_specs=(P(), P(AXIS)), out_specs=P(AXIS), check_vma=False
        )(params, batch)
