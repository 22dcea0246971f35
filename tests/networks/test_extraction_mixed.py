"""The extraction with activations in bfloat16: its rule is exact, its rounding small, and nothing
but the activations is rounded."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfr_jax.networks.cfr.iterations import unroll
from cfr_jax.networks.cfr.modules import init_params
from cfr_jax.networks.extraction import pooled_features
from cfr_jax.networks.extraction.mixed import pooled_mixed
from cfr_jax.networks.inputs import Cloud, Settings
from cfr_jax.networks.layers import Layer

N, K, WIDTH, GROUPS = 40, 16, 32, 8
MASK = jnp.arange(N) % 5 != 1


@pytest.fixture(scope="module")
def layers():
    rng = np.random.default_rng(0)

    def layer(inputs):
        negative = rng.random(WIDTH) < 0.25  # there the smallest value is the largest
        parts = (
            rng.normal(size=(inputs, WIDTH)) / np.sqrt(inputs),
            0.3 * rng.normal(size=WIDTH),
            0.3 * rng.normal(size=WIDTH) + np.where(negative, -1, 1),
            0.3 * rng.normal(size=WIDTH),
        )
        return Layer(*(jnp.asarray(part, jnp.float32) for part in parts))

    return tuple(layer(inputs) for inputs in (7, WIDTH, WIDTH))


@pytest.fixture(scope="module")
def raw():
    size = np.array([0.1, 0.1, 0.1, 0.5, 0.5, 0.5, 0.1])
    return jnp.asarray(size * np.random.default_rng(1).normal(size=(N, K, 7)), jnp.float32)


def answer_and_gradients(function, layers, raw):
    weight = jnp.asarray(np.random.default_rng(2).normal(size=(N, WIDTH)), jnp.float32)

    def loss(layers, raw):
        found = function(layers, raw)
        return jnp.sum(weight * found), found

    gradients, found = jax.jit(jax.grad(loss, (0, 1), has_aux=True))(layers, raw)
    return found, gradients


def exact(layers, raw, mask):
    return pooled_features(layers, raw, groups=GROUPS, mask=mask)


def mixed(layers, raw, mask, stored):
    valid = jnp.ones(N) if mask is None else mask.astype(jnp.float32)
    return pooled_mixed(layers, raw, valid, GROUPS, stored) * valid[:, None]


def apart(found, wanted):
    """The largest relative distance of two trees' leaves."""
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True)
    return max(float(jnp.linalg.norm(a - b) / jnp.linalg.norm(b)) for a, b in pairs)


@pytest.mark.parametrize("mask", [None, MASK], ids=["whole", "masked"])
def test_the_rule_is_exact_where_nothing_is_rounded(layers, raw, mask):
    wanted, gradients = answer_and_gradients(lambda *a: exact(*a, mask), layers, raw)

    found, ours = answer_and_gradients(lambda *a: mixed(*a, mask, jnp.float32), layers, raw)

    assert apart(found, wanted) < 1e-5
    assert apart(ours, gradients) < 1e-5


def test_repeated_neighbors_share_the_gradient_of_the_maximum(layers, raw):
    raw = raw.at[:, K // 2 :].set(raw[:, : K // 2])
    wanted, gradients = answer_and_gradients(lambda *a: exact(*a, None), layers, raw)

    found, ours = answer_and_gradients(lambda *a: mixed(*a, None, jnp.float32), layers, raw)

    assert apart(found, wanted) < 1e-5 and apart(ours, gradients) < 1e-5


def test_bfloat16_rounds_features_and_gradients_by_little(layers, raw):
    wanted, gradients = answer_and_gradients(lambda *a: exact(*a, MASK), layers, raw)

    def function(layers, raw):
        return pooled_features(layers, raw, groups=GROUPS, mask=MASK, activations="bfloat16")

    found, ours = answer_and_gradients(function, layers, raw)

    assert 1e-4 < apart(found, wanted) < 0.01  # eight bits: 0.004 at most of each value
    # a maximum may move to another neighbor, whose value is nearly the same
    assert 1e-3 < apart(ours, gradients) < 0.25
    for ours_leaf, leaf in zip(jax.tree.leaves(ours), jax.tree.leaves(gradients), strict=True):
        cosine = jnp.sum(ours_leaf * leaf) / jnp.linalg.norm(ours_leaf) / jnp.linalg.norm(leaf)
        assert cosine > 0.97
        assert ours_leaf.dtype == jnp.float32


def test_a_cloud_without_a_valid_point_has_zero_features_and_gradients(layers, raw):
    nothing = jnp.zeros(N, bool)

    found, gradients = answer_and_gradients(
        lambda *a: mixed(*a, nothing, jnp.bfloat16), layers, raw
    )

    for leaf in jax.tree.leaves((found, gradients)):
        assert not leaf.any()


def test_clouds_side_by_side_are_those_one_by_one(layers, raw):
    clouds = jnp.stack([raw, raw[::-1], 2 * raw])

    def function(raw):
        return pooled_features(layers, raw, groups=GROUPS, activations="bfloat16")

    together = jax.jit(jax.vmap(function))(clouds)

    alone = jnp.stack([function(cloud) for cloud in clouds])
    assert apart(together, alone) < 2e-3


def test_only_the_extraction_is_rounded():
    rng = np.random.default_rng(0)

    def cloud():
        points = jnp.asarray(rng.normal(size=(24, 3)), jnp.float32)
        neighbors = jnp.asarray(rng.integers(24, size=(24, 6)), jnp.int32)
        return Cloud(points, points, neighbors)

    source, target = cloud(), cloud()

    def transforms(params, source, target):
        settings = Settings(neighbors=6, activations="bfloat16")
        return [step.transform for step in unroll(params, source, target, settings)]

    params = init_params(jax.random.key(0), 2)
    program = str(jax.make_jaxpr(transforms)(params, source, target))

    rounded = [line for line in program.splitlines() if "bf16[" in line]
    # clouds of 24 x 6 rows, as planes and flat, too, or the weights of their layers: no affinity,
    # position or motion
    sizes = {size for line in rounded for size in shapes_in(line)}
    others = {(8, 24, 6), (24 * 6 * 96,), (8, 96), (96, 96), (24, 96)}
    assert sizes and all(size[:2] == (24, 6) or size in others for size in sizes)


def shapes_in(line):
    return [
        tuple(int(number) for number in found.split(","))
        for found in re.findall(r"bf16\[([\d,]+)\]", line)
    ]


@pytest.mark.parametrize("platform", ["cuda", "rocm", "tpu"])
def test_its_gradient_lowers_for_accelerators(layers, raw, platform):
    def loss(layers, raw):
        return jnp.sum(pooled_features(layers, raw, groups=GROUPS, activations="bfloat16"))

    traced = jax.jit(jax.grad(loss)).trace(layers, raw)
    text = traced.lower(lowering_platforms=(platform,)).as_text()

    products = [line for line in text.splitlines() if "stablehlo.dot_general" in line]
    rows = [line for line in products if f"{N * K}x" in line or f"{N}x{K}x" in line]
    assert len(rows) >= 8 and all("xbf16>" in line for line in rows)


def test_another_kind_of_number_is_refused(layers, raw, unchecked):
    with pytest.raises(ValueError, match="activations: got 'float16', wanted 'float32' or"):
        pooled_features(layers, raw, groups=GROUPS, activations="float16")
