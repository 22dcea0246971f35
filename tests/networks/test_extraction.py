"""The tiled extraction against its plain form: values, and the gradient written out by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfr_jax.networks import extraction
from cfr_jax.networks.cfr.modules import group_norm
from cfr_jax.networks.layers import Layer

N, K, WIDTH, GROUPS = 10, 4, 16, 4


def layers(seed=0, dtype=np.float32):
    rng = np.random.default_rng(seed)
    made = []
    for inputs in (7, WIDTH, WIDTH):
        parts = (
            rng.normal(size=(inputs, WIDTH)) / np.sqrt(inputs),
            rng.normal(size=WIDTH),
            rng.normal(size=WIDTH),  # negative scales: there the smallest value is the largest
            rng.normal(size=WIDTH),
        )
        made.append(Layer(*(jnp.asarray(part, dtype) for part in parts)))
    return tuple(made)


def channels(seed=1, dtype=np.float32):
    return jnp.asarray(np.random.default_rng(seed).normal(size=(N, K, 7)), dtype)


def plain(layers, raw, groups=GROUPS):
    """Linear, GroupNorm, ReLU three times on all rows, then the maximum."""
    n, k, _ = raw.shape
    rows = raw.reshape(n * k, -1)
    for layer in layers:
        rows = rows @ layer.kernel + layer.bias
        rows = jax.nn.relu(group_norm(rows, layer.scale, layer.shift, groups=groups))
    return rows.reshape(n, k, -1).max(axis=1)


def tiled(layers, raw, mask=None):
    return extraction.pooled_features(layers, raw, groups=GROUPS, mask=mask)


TILES = {
    "one tile": (4096, 1 << 20),
    "four tiles, the last not full": (3 * K, 1 << 20),
    "four tiles, two of them kept": (3 * K, 2 * 3 * K * WIDTH),
}


@pytest.fixture(params=TILES.values(), ids=TILES.keys())
def tiles(request, monkeypatch):
    rows, kept = request.param
    monkeypatch.setattr(extraction.tiles, "ROWS", rows)
    monkeypatch.setattr(extraction.tiles, "KEPT", kept)


MASK = jnp.arange(N) % 3 != 1


def test_features_are_those_of_the_plain_form(tiles):
    found = jax.jit(lambda *a: tiled(*a))(layers(), channels())

    np.testing.assert_allclose(found, plain(layers(), channels()), atol=1e-5)


def test_masked_rows_enter_nothing_and_get_nothing(tiles):
    raw = jnp.where(MASK[:, None, None], channels(), 1e3)

    found = jax.jit(lambda *a: tiled(*a))(layers(), raw, MASK)

    np.testing.assert_allclose(found[MASK], plain(layers(), channels()[MASK]), atol=1e-5)
    assert not found[~MASK].any()


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("repeated", [False, True], ids=["distinct", "repeated neighbors"])
def test_gradients_are_those_of_the_plain_form(x64, tiles, masked, repeated):
    given, raw = layers(dtype=np.float64), channels(dtype=np.float64)
    if repeated:  # as the radius rule makes them: several rows reach the maximum
        raw = raw.at[:, 1].set(raw[:, 0])
    mask = MASK if masked else jnp.ones(N, bool)
    pull = jnp.asarray(np.random.default_rng(2).normal(size=(N, WIDTH)))

    found = jax.jit(jax.grad(lambda *a: jnp.sum(tiled(*a, mask) * pull), (0, 1)))(given, raw)

    wanted = jax.jit(
        jax.grad(lambda given, raw: jnp.sum(plain(given, raw[mask]) * pull[mask]), (0, 1))
    )(given, raw)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)


def test_gradients_are_their_finite_differences(x64):
    rng = np.random.default_rng(3)
    at = layers(dtype=np.float64), channels(dtype=np.float64)
    towards = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), at)
    pull = jnp.asarray(rng.normal(size=(N, WIDTH)))
    total = jax.jit(lambda given, raw: jnp.sum(tiled(given, raw, MASK) * pull))
    step = 1e-7

    gradients = jax.jit(jax.grad(total, (0, 1)))(*at)

    derivative = sum(jax.tree.leaves(jax.tree.map(lambda g, t: jnp.sum(g * t), gradients, towards)))
    ahead, behind = (
        total(*jax.tree.map(lambda a, t, s=sign: a + s * step * t, at, towards)) for sign in (1, -1)
    )
    np.testing.assert_allclose(derivative, (ahead - behind) / (2 * step), rtol=1e-5)


value_and_slope = jax.jit(
    jax.value_and_grad(lambda given, raw, mask: jnp.sum(tiled(given, raw, mask) ** 2), (0, 1))
)


@pytest.mark.parametrize("valid", [N, 1, 0])
@pytest.mark.parametrize("scale", [0.0, 1e-6, 1e6])
def test_gradients_are_finite_whatever_comes_in(scale, valid):
    value, gradients = value_and_slope(layers(), channels() * scale, jnp.arange(N) < valid)

    assert np.isfinite(value)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))
