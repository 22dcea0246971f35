"""The learned modules: their norm, their parameters, their order."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import pieces
from oracle.network import annealing

from cfr_jax.networks.cfr.modules import CFR, init_params
from cfr_jax.networks.layers import group_norm, unit_rows


def given(seed=0, dtype=np.float32):
    rng = np.random.default_rng(seed)
    x, scale, shift = 5 + 3 * rng.normal(size=(9, 16)), rng.normal(size=16), rng.normal(size=16)
    return tuple(jnp.asarray(a, dtype) for a in (x, scale, shift))


def test_group_norm_is_the_references_and_knows_masks():
    x, scale, shift = given()
    mask = np.arange(9) % 3 != 1
    junk = jnp.where(mask[:, None], x, 1e4)

    whole = group_norm(x, scale, shift, groups=4)
    part = group_norm(junk, scale, shift, groups=4, mask=jnp.asarray(mask))

    x, scale, shift = (np.asarray(a, np.float64) for a in (x, scale, shift))
    np.testing.assert_allclose(whole, pieces.group_norm(x, scale, shift, 4), atol=2e-6)
    np.testing.assert_allclose(part[mask], pieces.group_norm(x[mask], scale, shift, 4), atol=2e-6)


def test_group_norm_has_its_finite_differences_as_derivative(x64):
    rng = np.random.default_rng(1)
    at = given(1, np.float64)
    towards = tuple(jnp.asarray(rng.normal(size=a.shape)) for a in at)
    mask, step = jnp.arange(9) % 3 != 1, 1e-6
    norm = jax.jit(lambda *a: group_norm(*a, groups=4, mask=mask))

    _, derivative = jax.jvp(norm, at, towards)

    ahead, behind = (
        norm(*(a + sign * step * t for a, t in zip(at, towards, strict=True))) for sign in (1, -1)
    )
    np.testing.assert_allclose(derivative, (ahead - behind) / (2 * step), atol=1e-7)


@pytest.mark.parametrize("scale", [0.0, 1e-15, 1e-11, 1.0, 1e15])
def test_rows_are_brought_to_length_one_with_finite_gradients(scale):
    x = given()[0].at[0].set(0) * np.float32(scale)

    rows = unit_rows(x)

    wanted = np.full(9, float(scale > 1e-12))
    wanted[0] = 0
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), wanted, atol=1e-6)
    assert np.isfinite(jax.grad(lambda x: jnp.sum(unit_rows(x)[:, 0]))(x)).all()


def test_fresh_parameters_are_the_papers_in_number_and_drawn_as_pytorch_draws():
    params = jax.jit(init_params)(jax.random.key(0))

    assert 0.85e6 < sum(leaf.size for leaf in jax.tree.leaves(params)) < 0.9e6
    kernels = [
        (params["features"]["kernel_0"], 7),
        (params["features"]["kernel_2"], 96),
        (params["cascade"]["kernel"], 96),
        (params["cascade"]["position"], 3),
        (params["annealing"]["pair_0_dense"]["kernel"], 1024),
    ]
    for kernel, inputs in kernels:
        assert np.abs(kernel).max() <= 1 / np.sqrt(inputs)
        np.testing.assert_allclose(np.std(kernel), 1 / np.sqrt(3 * inputs), rtol=0.1)
    assert not np.array_equal(params["cascade"]["kernel"][0], params["cascade"]["kernel"][1])


def test_the_reference_runs_through_the_layers_in_their_order(params):
    network = CFR(5).bind({"params": params})
    rng = np.random.default_rng(2)
    features = jnp.asarray(rng.normal(size=(9, 96)), jnp.float32)
    points = jnp.asarray(rng.normal(size=(9, 3)), jnp.float32)

    every = network.cascade.at_rest(features, points)

    for i, found in enumerate(every):
        features = network.cascade.layer(i, features, points)
        np.testing.assert_allclose(found, features, atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-6)


def test_annealing_is_positive_and_tells_the_clouds_apart(params):
    network = CFR(5).bind({"params": params})
    rng = np.random.default_rng(3)
    source, target = (jnp.asarray(rng.normal(size=(n, 3)), jnp.float32) for n in (9, 11))

    there, back = network.annealing(source, target), network.annealing(target, source)

    assert there.beta.shape == there.alpha.shape == (5,)
    assert (there.beta > 0).all() and (there.alpha > 0).all()
    assert np.abs(there.beta - back.beta).max() > 1e-4


@pytest.mark.parametrize("masked", [None, "source", "target", "both"])
def test_annealing_is_the_references_padded_or_not(params, state_dict, masked):
    rng = np.random.default_rng(4)
    clouds = [rng.normal(size=(n, 3)).astype(np.float32) for n in (9, 11)]
    masks = [jnp.arange(len(cloud)) % 3 != 1 for cloud in clouds]
    masks = [
        m if masked in ("both", of) else None
        for m, of in zip(masks, ("source", "target"), strict=True)
    ]
    network = CFR(5).bind({"params": params})

    found = network.annealing(*map(jnp.asarray, clouds), *masks)

    kept = [c if mask is None else c[mask] for c, mask in zip(clouds, masks, strict=True)]
    wanted = annealing(state_dict, *kept)
    np.testing.assert_allclose(np.concatenate(found), wanted, rtol=2e-5)
