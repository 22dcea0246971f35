"""The tiled extraction against its plain form: values, and the gradient written out by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfr_jax.networks.extraction import pooled_features
from cfr_jax.networks.extraction.backward import backward
from cfr_jax.networks.extraction.forward import forward
from cfr_jax.networks.extraction.tiles import ACCELERATOR, CPU, Limits, tiling_of
from cfr_jax.networks.layers import Layer, group_norm

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


def tiled(layers, raw, mask=None, limits=CPU):
    return pooled_features(layers, raw, groups=GROUPS, mask=mask, on_cpu=limits)


ALL, HALF = 1 << 20, 2 * 3 * K * WIDTH  # numbers kept
LIMITS = {
    "one tile": (Limits(4096, ALL), (1, 10)),
    "four tiles, the last not full": (Limits(3 * K, ALL), (4, 3)),
    "four tiles, two of them kept": (Limits(3 * K, HALF), (4, 3)),
    "two double tiles": (Limits(3 * K, ALL, at_once=2), (2, 6)),
    "two double tiles, one of them kept": (Limits(3 * K, HALF, at_once=2), (2, 6)),
    "one step, as on accelerators": (ACCELERATOR._replace(rows=3 * K), (1, 12)),
}


@pytest.fixture(params=LIMITS)
def limits(request):
    """What a function that is compiled is told, and so compiled for."""
    limits, tiling = LIMITS[request.param]
    assert tiling_of(N, K, limits) == tiling
    return limits


MASK = jnp.arange(N) % 3 != 1


def test_features_are_those_of_the_plain_form(limits):
    found = tiled(layers(), channels(), limits=limits)

    np.testing.assert_allclose(found, plain(layers(), channels()), atol=1e-5)


def test_masked_rows_enter_nothing_and_get_nothing(limits):
    raw = jnp.where(MASK[:, None, None], channels(), 1e3)

    found = tiled(layers(), raw, MASK, limits)

    np.testing.assert_allclose(found[MASK], plain(layers(), channels()[MASK]), atol=1e-5)
    assert not found[~MASK].any()


@pytest.mark.parametrize(("masked", "repeated"), [(False, False), (True, True)])
def test_gradients_are_those_of_the_plain_form(x64, limits, masked, repeated):
    given, raw = layers(dtype=np.float64), channels(dtype=np.float64)
    if repeated:  # as the radius rule makes them: several rows reach the maximum
        raw = raw.at[:, 1].set(raw[:, 0])
    mask = MASK if masked else jnp.ones(N, bool)
    pull = jnp.asarray(np.random.default_rng(2).normal(size=(N, WIDTH)))

    found = jax.jit(jax.grad(lambda *a: jnp.sum(tiled(*a, mask, limits) * pull), (0, 1)))(
        given, raw
    )

    wanted = jax.jit(
        jax.grad(lambda given, raw: jnp.sum(plain(given, raw[mask]) * pull[mask]), (0, 1))
    )(given, raw)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("rows_kept", [12, 40])
@pytest.mark.parametrize("name", LIMITS)
def test_what_another_platform_did_not_keep_is_made_again(x64, name, rows_kept):
    """Both platforms keep what a CPU can, and an accelerator's one step may need more."""
    given, raw = layers(dtype=np.float64), channels(dtype=np.float64)
    limits, valid = LIMITS[name][0]._replace(kept=ALL), MASK.astype(raw.dtype)
    pull = jnp.asarray(np.random.default_rng(2).normal(size=(N, WIDTH))) * valid[:, None]

    @jax.jit
    def slope(given, raw):
        _, kept = forward(given, raw, valid, groups=GROUPS, limits=limits, rows_kept=rows_kept)
        assert len(kept.second) == rows_kept
        return backward(given, raw, valid, kept, pull, groups=GROUPS, limits=limits)[:2]

    wanted = jax.grad(lambda *a: jnp.sum(tiled(*a, MASK) * pull), (0, 1))(given, raw)
    for a, b in zip(*map(jax.tree.leaves, (slope(given, raw), wanted)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)


def test_to_an_accelerator_the_cloud_is_one_tile():
    program = jax.jit(jax.grad(lambda given, raw: jnp.sum(tiled(given, raw)), (0, 1)))
    given = jax.tree.map(lambda part: jax.ShapeDtypeStruct(part.shape, part.dtype), layers())
    traced = program.trace(given, jax.ShapeDtypeStruct((12_000, 64, 7), jnp.float32))

    for platform in ("cpu", "cuda", "rocm", "tpu"):
        text = traced.lower(lowering_platforms=(platform,)).as_text()
        assert ("stablehlo.while" in text) == (platform == "cpu")


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
    jax.value_and_grad(
        lambda given, raw, mask, limits: jnp.sum(tiled(given, raw, mask, limits) ** 2), (0, 1)
    ),
    static_argnums=3,
)


@pytest.mark.parametrize("valid", [N, 1, 0])
@pytest.mark.parametrize("scale", [0.0, 1e-6, 1e6])
@pytest.mark.parametrize("platform", [CPU, ACCELERATOR], ids=["CPU", "accelerator"])
def test_gradients_are_finite_whatever_comes_in(platform, scale, valid):
    mask = jnp.arange(N) < valid

    value, gradients = value_and_slope(layers(), channels() * scale, mask, platform)

    assert np.isfinite(value)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))
