"""Gradients of DCP, FMR and RGM in training: finite on any clouds, and right on ordinary ones."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import clouds
from test_gradients import CLOUDS

from cfr_jax.geometry.neighbors import nearest_on_host
from cfr_jax.networks import table
from cfr_jax.networks.inputs import Cloud
from cfr_jax.networks.peers import dcp, fmr, rgm
from cfr_jax.networks.peers.batch_norm import PAIRS

N, M, K, WIDTH, PAIRS_OF_BATCH = 24, 28, 6, 8, 2
SETTINGS = {
    "dcp": dcp.DCPSettings(neighbors=K, training=True),
    "fmr": fmr.FMRSettings(iterations=3, supervised=True),
    "rgm": rgm.RGMSettings(neighbors=K, passes=3, training=True),
}


def fresh(name):
    width = {} if name == "fmr" else {"width": WIDTH}
    with jax.enable_x64(False):
        return table.named(name).fresh(jax.random.key(0), **width)


def batch(kind, other=None, seed=0):
    """Two pairs of clouds of a kind."""
    sides = []
    for side, (n, of) in enumerate(((N, kind), (M, other or kind))):
        points = np.stack(
            [
                CLOUDS[of](np.random.default_rng([seed, side, pair]), n).astype(np.float32)
                for pair in range(PAIRS_OF_BATCH)
            ]
        )
        found = np.stack([nearest_on_host(each, K) for each in points])
        sides.append(Cloud(jnp.asarray(points), jnp.zeros(points.shape), jnp.asarray(found)))
    return sides


def total(name, params, source, target, truth):
    goal = functools.partial(table.named(name).objective, settings=SETTINGS[name])
    found = jax.vmap(goal, (None, 0, 0, None), axis_name=PAIRS)(params, source, target, truth)
    return jnp.mean(found.loss)


# compiled without care for speed: each program runs a few times on a few points
@functools.partial(
    jax.jit, static_argnums=0, compiler_options={"xla_backend_optimization_level": 0}
)
def slope(name, *given):
    return jax.value_and_grad(functools.partial(total, name))(*given)


@pytest.mark.parametrize("name", SETTINGS)
@pytest.mark.parametrize("kind", CLOUDS)
def test_gradients_are_finite_for_any_cloud(name, kind):
    value, gradients = slope(name, fresh(name), *batch(kind), jnp.eye(4))

    assert np.isfinite(value)
    for path, leaf in jax.tree.leaves_with_path(gradients):
        assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)


@pytest.mark.parametrize("name", SETTINGS)
def test_gradients_are_their_finite_differences_through_the_statistics_of_the_batch(x64, name):
    # then one step along a direction changes the loss as the gradient says
    rng = np.random.default_rng(0)
    params = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), fresh(name))
    sides = []
    for seeds in (((0, N), (1, N)), ((2, M), (3, M))):
        points = [clouds.random_pair(seed, n, n).x.astype(np.float64) for seed, n in seeds]
        found = [nearest_on_host(each, K) for each in points]
        sides.append(
            Cloud(jnp.asarray(points), jnp.zeros(np.shape(points)), jnp.asarray(np.stack(found)))
        )
    truth = jnp.eye(4, dtype=jnp.float64).at[0, 3].set(0.1)
    towards = jax.tree.map_with_path(
        # no gradient reaches the running statistics but that of following the batch
        lambda path, leaf: jnp.asarray(rng.normal(size=leaf.shape) * (path[-1].key[:3] != "run")),
        params,
    )

    _, gradients = slope(name, params, *sides, truth)

    along = sum(
        float(jnp.sum(g * t))
        for g, t in zip(jax.tree.leaves(gradients), jax.tree.leaves(towards), strict=True)
    )
    sides_of = [
        float(
            slope(
                name,
                jax.tree.map(lambda p, t, s=s: p + s * 1e-9 * t, params, towards),
                *sides,
                truth,
            )[0]
        )
        for s in (1, -1)
    ]
    assert abs(along) > 1e-4
    np.testing.assert_allclose(along, (sides_of[0] - sides_of[1]) / 2e-9, rtol=1e-3)


def test_every_learned_parameter_has_a_gradient():
    for name in SETTINGS:
        _, gradients = slope(name, fresh(name), *batch("random"), jnp.eye(4))
        for path, leaf in jax.tree.leaves_with_path(gradients):
            # those of a softmax's keys do not change it
            still = [part.key for part in path[-2:]] == ["key", "bias"]
            assert still or np.abs(leaf).max() > 0, f"{name} {jax.tree_util.keystr(path)}"
