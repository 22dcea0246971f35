"""Compares a training step with a naive one: python benchmarks/train_step.py

The naive step is the obvious program: neighbors by `top_k` on the device, the per-neighbor MLP as
plain matrix products and norms, `vmap` over the batch, and `jax.grad` of the mean loss. Both have
the same network, optimizer and loss, and must give the same loss value. Our step gets its neighbors
from the host; their time is counted here, although in training the host works ahead. On a CPU, our
step has one device per core, as in `train.py`, and the naive step has one device with all cores.
Run it on a machine that does nothing else.
"""

from __future__ import annotations

import argparse
import functools
import os
import time
from collections.abc import Callable
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import optax

from cfr_jax.data.augmentation.sampling import Sampling
from cfr_jax.data.corpus import Corpus
from cfr_jax.data.loader import batch_at
from cfr_jax.data.sources import ShapeSource
from cfr_jax.geometry.neighbors import nearest_on_host
from cfr_jax.networks import annealing
from cfr_jax.networks.cfr import modules as network
from cfr_jax.networks.cfr.iterations import unroll
from cfr_jax.networks.inputs import Cloud, Settings
from cfr_jax.networks.layers import apply_layer
from cfr_jax.training import devices, optimizers, step
from cfr_jax.training.losses import pair_loss


def main() -> None:
    """Prints the losses of both steps and their milliseconds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=358)
    parser.add_argument("--neighbors", type=int, default=32)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()

    jax.config.update("jax_num_cpu_devices", devices.of_cores(args.batch) or -1)
    schedule = optimizers.make_schedule("cosine", peak_rate=1e-3, steps=1000, warmup=0.1)
    optimizer = optimizers.make_optimizer("adamw", schedule, clip=1.0, weight_decay=1e-5)
    sampling = Sampling(points=args.points, neighbors=args.neighbors)
    batch = batch_at(ShapeSource(ellipsoids()), 0, args.batch, sampling, seed=0)
    print(f"{jax.devices()[0].device_kind}, {len(os.sched_getaffinity(0))} CPU cores, "
          f"{len(jax.devices())} devices, jax "
          f"{jax.__version__}; {args.points} points, {args.neighbors} neighbors, batch "
          f"{args.batch}, {args.repeats} repeats, milliseconds\n")  # fmt: skip
    cpu = jax.default_backend() == "cpu"
    recipe = step.Recipe(
        unroll=unroll,
        settings=Settings(neighbors=args.neighbors, detach_motion=True),
        optimizer=optimizer,
        mesh=devices.make_mesh(),
        correspondence_weight=0.05,
        average_decay=0.999,
        pairs_at_once=1 if cpu else args.batch // len(jax.devices()),
        precision="float32",
        max_skipped=20,
    )

    def ours(state):
        searched = {
            f"{side}_neighbors": np.stack(
                [nearest_on_host(cloud, args.neighbors, radius=0.3) for cloud in batch[side]]
            )
            for side in ("source", "target")
        }
        placed = devices.spread(batch | searched, recipe.mesh)
        state, measured = step.train_step(state, placed, recipe=recipe)
        return state, measured.total.mean()

    one = jax.make_mesh((1,), (devices.AXIS,), devices=jax.devices()[:1])
    naive = functools.partial(
        naive_step, batch=batch, optimizer=optimizer, neighbors=args.neighbors
    )
    with (
        mock.patch.object(network, "pooled_features", plain_features),
        mock.patch.object(annealing, "pooled_layer", plain_layer),
    ):
        slow, loss_naive = measure("naive", naive, start(optimizer, one), args.repeats)
    fast, loss = measure("ours", ours, start(optimizer, recipe.mesh), args.repeats)
    print(f"\nlosses of the first step: {loss_naive:.6f} and {loss:.6f}")
    print(f"ours is {slow / fast:.2f} times faster (medians)")


def ellipsoids() -> Corpus:
    """Sixteen shapes of 2048 points with normals."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(16, 2048, 3))
    points /= np.linalg.norm(points, axis=-1, keepdims=True)
    axes = rng.uniform(0.3, 1, size=(16, 1, 3))
    normals = points / axes
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return Corpus(
        points=(points * axes).astype(np.float32),
        normals=normals.astype(np.float32),
        labels=np.zeros(16, np.int64),
        names=tuple(f"ellipsoid {i}" for i in range(16)),
        categories=("ellipsoid",),
    )


@functools.partial(jax.jit, static_argnames=("optimizer", "neighbors"), donate_argnames=("state",))
def naive_step(state: step.TrainState, *, batch, optimizer, neighbors):
    """The same step without our optimizations."""

    def loss(params, pair):
        clouds = [
            Cloud(pair[side], pair[f"{side}_normals"], by_top_k(pair[side], neighbors, 0.3))
            for side in ("source", "target")
        ]
        settings = Settings(neighbors=neighbors, detach_motion=True)
        found = unroll(params, *clouds, settings)
        return pair_loss(found, *clouds, pair["transform"], correspondence_weight=0.05).total

    def mean_loss(params):
        return jax.vmap(functools.partial(loss, params))(batch).mean()

    total, gradient = jax.value_and_grad(mean_loss)(state.params)
    updates, moments = optimizer.update(gradient, state.optimizer, state.params)
    params = optax.apply_updates(state.params, updates)
    average = jax.tree.map(lambda a, p: a + 0.001 * (p - a), state.average, params)
    return (
        state.replace(step=state.step + 1, params=params, average=average, optimizer=moments),
        total,
    )


def by_top_k(points, count, radius):
    """The nearest other points; those beyond the radius are replaced by the nearest one."""
    square = jnp.sum((points[:, None] - points[None]) ** 2, axis=-1)
    square = jnp.where(jnp.eye(len(points), dtype=bool), jnp.inf, square)
    near, found = jax.lax.top_k(-square, count)
    return jnp.where(-near <= radius**2, found, found[:, :1]).astype(jnp.int32)


def plain_features(layers, raw, *, groups, mask=None, columns=None, activations="float32"):
    """`extraction.pooled_features` written out."""
    n, k, _ = raw.shape
    x = raw.reshape(n * k, -1)
    for layer in layers:
        x = jax.nn.relu(apply_layer(layer, x, groups=groups))
    return x.reshape(n, k, -1).max(axis=1)


def plain_layer(layer, x, *, groups, mask=None):
    """`pooling.pooled_layer` written out."""
    return jax.nn.relu(apply_layer(layer, x, groups=groups)).max(axis=0)


def start(optimizer, mesh) -> step.TrainState:
    """A training state at step zero, on these devices."""
    return devices.replicate(
        step.init_state(network.init_params(jax.random.key(0)), optimizer), mesh
    )


def measure(what: str, advance: Callable, state, repeats: int) -> tuple[float, float]:
    """Median milliseconds of a step, without the first one, which compiles, and the first loss."""
    times, used, losses = [], [], []
    for _ in range(repeats + 1):
        began, worked = time.perf_counter(), time.process_time()
        state, loss = jax.block_until_ready(advance(state))
        times.append(1e3 * (time.perf_counter() - began))
        used.append(1e3 * (time.process_time() - worked))
        losses.append(float(loss))
    first, *others = times
    print(f"{what:<8} first {first:>9.0f}   median {np.median(others):>8.0f}   "
          f"fastest {min(others):>8.0f}   processors {np.median(used[1:]):>8.0f}",
          flush=True)  # fmt: skip
    return float(np.median(others)), losses[0]


if __name__ == "__main__":
    main()
