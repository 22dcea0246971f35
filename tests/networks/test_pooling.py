"""PointNet's wide layer in one go, against its plain form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfr_jax.networks.layers import Layer, group_norm
from cfr_jax.networks.pooling import pooled_layer

N, INPUTS, WIDTH, GROUPS = 12, 5, 16, 4
MASK = jnp.arange(N) % 3 != 1


def given(dtype=np.float64):
    rng = np.random.default_rng(0)
    parts = rng.normal(size=(INPUTS, WIDTH)), *rng.normal(size=(3, WIDTH))  # negative scales, too
    layer = Layer(*(jnp.asarray(part, dtype) for part in parts))
    return layer, jnp.asarray(rng.normal(size=(N, INPUTS)), dtype)


def plain(layer, x):
    z = group_norm(x @ layer.kernel + layer.bias, layer.scale, layer.shift, groups=GROUPS)
    return jax.nn.relu(z).max(axis=0)


@pytest.mark.parametrize("rows", [N, 5], ids=["one tile", "three tiles"])
@pytest.mark.parametrize("mask", [None, MASK], ids=["all", "masked"])
def test_values_and_gradients_are_those_of_the_plain_form(x64, mask, rows):
    layer, x = given()
    valid = slice(None) if mask is None else mask
    pull = jnp.asarray(np.random.default_rng(1).normal(size=WIDTH))

    def found(layer, x):
        pooled = pooled_layer(layer, x, groups=GROUPS, mask=mask, on_cpu=rows)
        return jnp.sum(pooled * pull), pooled

    def wanted(layer, x):
        pooled = plain(layer, x[valid])
        return jnp.sum(pooled * pull), pooled

    here, there = (jax.jit(jax.grad(f, (0, 1), has_aux=True))(layer, x) for f in (found, wanted))
    for a, b in zip(jax.tree.leaves(here), jax.tree.leaves(there), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)


slope = jax.jit(
    jax.grad(
        lambda layer, x, mask: jnp.sum(pooled_layer(layer, x, groups=GROUPS, mask=mask)), (0, 1)
    )
)


@pytest.mark.parametrize("valid", [N, 1, 0])
@pytest.mark.parametrize("scale", [0.0, 1e-6, 1e6])
def test_gradients_are_finite_whatever_comes_in(scale, valid):
    layer, x = given(np.float32)

    gradients = slope(layer, x * scale, jnp.arange(N) < valid)

    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))


def test_an_accelerator_takes_a_large_pair_in_one_step():
    layer, x = given(np.float32)
    rows = jax.ShapeDtypeStruct((24_000, INPUTS), x.dtype)
    traced = slope.trace(layer, rows, jax.ShapeDtypeStruct((24_000,), bool))

    for platform in ("cpu", "cuda", "rocm", "tpu"):
        text = traced.lower(lowering_platforms=(platform,)).as_text()
        assert ("stablehlo.while" in text) == (platform == "cpu")


def test_memory_for_the_wide_layer_does_not_grow_with_the_clouds():
    def needed(n):
        parts = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in [(4, 256)] + 3 * [(256,)]]
        x = jax.ShapeDtypeStruct((n, 4), jnp.float32)
        compiled = slope.lower(Layer(*parts), x, jax.ShapeDtypeStruct((n,), bool)).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    wide = 256 * 4
    assert needed(200_000) < needed(20_000) + 180_000 * wide / 4
