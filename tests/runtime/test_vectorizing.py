"""A batch of clouds: one by one on a CPU, side by side elsewhere, with the same results."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfr_jax.networks.extraction import pooled_features
from cfr_jax.networks.layers import Layer
from cfr_jax.runtime.tracing.vectorizing import cloud_by_cloud


def parts(weights, rows):
    """A function with two results, one of them a tuple, like the heavy functions."""
    return jnp.tanh(rows @ weights["kernel"]), (weights["shift"] + rows.sum(0),)


def other(weights, rows):
    """The same plus 0.5, which shows that this function ran."""
    return jax.tree.map(lambda part: part + 0.5, parts(weights, rows))


WEIGHTS = {"kernel": jnp.arange(12.0).reshape(3, 4) / 12, "shift": jnp.array([1.0, 2.0, 3.0])}
ROWS = jnp.asarray(np.random.default_rng(0).normal(size=(5, 6, 3)), jnp.float32)


@pytest.mark.parametrize("axes", [(None, 0), ({"kernel": None, "shift": 0}, 0), (None, 1)])
def test_a_batch_processed_in_turn_gives_the_same_results(axes):
    weights = dict(WEIGHTS)
    rows = jnp.moveaxis(ROWS, 0, axes[1])
    if axes[0] is not None:
        weights["shift"] = jnp.stack([WEIGHTS["shift"] * i for i in range(5)])

    found = jax.vmap(cloud_by_cloud(parts, other), axes)(weights, rows)

    wanted = jax.vmap(parts, axes)(weights, rows)
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7)  # of entries of order one


def test_each_platform_runs_its_own_function():
    one = jax.jit(cloud_by_cloud(parts, other)).trace(WEIGHTS, ROWS[0])
    batch = jax.jit(jax.vmap(cloud_by_cloud(parts, other), (None, 0))).trace(WEIGHTS, ROWS)

    for program in (one, batch):
        for platform in ("cpu", "cuda", "rocm", "tpu"):
            text = program.lower(lowering_platforms=(platform,)).as_text()
            assert ("5.000000e-01" in text) == (platform != "cpu")


def test_only_a_cpu_processes_a_batch_in_turn():
    batch = jax.jit(jax.vmap(cloud_by_cloud(parts, parts), (None, 0)))

    def loops(platform):
        lowered = batch.trace(WEIGHTS, ROWS).lower(lowering_platforms=(platform,))
        return "stablehlo.while" in lowered.as_text()

    assert loops("cpu") and not any(map(loops, ("cuda", "rocm", "tpu")))


def test_batched_features_have_the_gradients_of_each_cloud():
    rng = np.random.default_rng(1)
    draw = lambda *shape: jnp.asarray(rng.normal(size=shape), jnp.float32)  # noqa: E731
    layers = tuple(Layer(draw(i, 8), draw(8), draw(8), draw(8)) for i in (7, 8, 8))
    clouds = draw(3, 10, 4, 7)

    def score(layers, raw):
        return jnp.sum(jnp.sin(pooled_features(layers, raw, groups=2)))

    def together(layers):
        return jnp.sum(jax.vmap(score, (None, 0))(layers, clouds))

    found = jax.jit(jax.grad(together))(layers)

    each = [jax.jit(jax.grad(score))(layers, raw) for raw in clouds]
    for a, *b in zip(*map(jax.tree.leaves, (found, *each)), strict=True):
        np.testing.assert_allclose(a, sum(b), atol=1e-4)
