"""Gradients of `register`: finite for any finite clouds, and right for ordinary ones."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import clouds

from cfr_jax.geometry.neighbors import nearest_on_host
from cfr_jax.networks.cfr.registration import register
from cfr_jax.networks.inputs import Settings, moved_by, prepare

N, M, K = 24, 28, 6
SMALL = Settings(neighbors=K)

CLOUDS = {
    "random": lambda rng, n: rng.normal(size=(n, 3)) / 2,
    "planar": lambda rng, n: rng.normal(size=(n, 3)) * [0.5, 0.5, 0],
    "collinear": lambda rng, n: rng.normal(size=(n, 1)) * [[0.1, 0.2, 0.3]],
    "pairs of one point": lambda rng, n: np.repeat(rng.normal(size=(n // 2, 3)), 2, axis=0),
    "one point": lambda rng, n: np.full((n, 3), 0.5),
    "origin": lambda rng, n: np.zeros((n, 3)),
    "tiny": lambda rng, n: rng.normal(size=(n, 3)) * 1e-6,
    "huge": lambda rng, n: rng.normal(size=(n, 3)) * 1e6,
}


def total(params, source, target, cascades=1):
    found = register(params, source, target, iterations=2, cascades=cascades, settings=SMALL)
    pull = jnp.cos(jnp.arange(16, dtype=found.transform.dtype)).reshape(4, 4)
    return jnp.sum(found.transforms * pull) + jnp.sum(found.weights**2) + jnp.sum(found.covered**2)


slope = jax.jit(jax.value_and_grad(total, (0, 1, 2)))


def cloud(name, seed, n, given_normals):
    rng = np.random.default_rng(seed)
    points = CLOUDS[name](rng, n)
    if not given_normals:
        return jnp.asarray(points, jnp.float32)
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return jnp.asarray(np.concatenate([points, normals], axis=1), jnp.float32)


def assert_finite(tree):
    for path, leaf in jax.tree.leaves_with_path(tree):
        assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)


@pytest.mark.parametrize("given_normals", [True, False], ids=["normals", "estimated"])
@pytest.mark.parametrize("name", CLOUDS)
def test_gradients_are_finite_for_any_cloud(params, name, given_normals):
    source, target = cloud(name, 0, N, given_normals), cloud(name, 1, M, given_normals)

    value, gradients = slope(params, source, target)

    assert np.isfinite(value)
    assert_finite(gradients)


@pytest.mark.parametrize("name", ["planar", "origin", "huge"])
def test_gradients_are_finite_between_unlike_clouds(params, name):
    value, gradients = slope(params, cloud(name, 0, N, True), cloud("random", 1, M, True))

    assert np.isfinite(value)
    assert_finite(gradients)


def test_gradients_are_finite_and_zero_in_the_padding(params):
    pair = clouds.random_pair(0, N, M)
    mask = jnp.arange(N) < 20

    def masked(params, source, target):
        source = prepare(source, mask=mask, settings=SMALL)
        found = register(params, source, target, iterations=1, settings=SMALL)
        return jnp.sum(found.transform[:3] ** 2 * jnp.arange(1, 5, dtype=jnp.float32))

    gradients = jax.jit(jax.grad(masked, (0, 1, 2)))(
        params, jnp.asarray(pair.x), jnp.asarray(pair.y)
    )

    assert_finite(gradients)
    assert gradients[1][:20].any() and not gradients[1][20:].any()


@pytest.mark.parametrize("cascades", [1, 2])
@pytest.mark.parametrize("of", ["params", "source", "target"])
def test_gradients_are_their_finite_differences(x64, params, of, cascades):
    # the neighbors are held: which they are does not differentiate
    pair = clouds.random_pair(1, N, M)
    rng = np.random.default_rng(2)
    held = [jnp.asarray(nearest_on_host(points, K, radius=0.3)) for points in (pair.x, pair.y)]
    at = (
        jax.tree.map(lambda leaf: leaf.astype(jnp.float64), params),
        jnp.asarray(np.concatenate([pair.x, pair.nx], axis=1), jnp.float64),
        jnp.asarray(np.concatenate([pair.y, pair.ny], axis=1), jnp.float64),
    )
    which = ("params", "source", "target").index(of)
    towards = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), at[which])

    value, gradients = in_double(*at, *held, cascades)

    derivative = sum(
        jax.tree.leaves(jax.tree.map(lambda g, t: jnp.sum(g * t), gradients[which], towards))
    )
    step = 1e-7
    sides = []
    for sign in (1, -1):
        moved = list(at)
        moved[which] = jax.tree.map(lambda a, t, s=sign: a + s * step * t, at[which], towards)
        sides.append(in_double(*moved, *held, cascades)[0])
    np.testing.assert_allclose(derivative, (sides[0] - sides[1]) / (2 * step), rtol=1e-5)


@functools.partial(jax.jit, static_argnums=5)
def in_double(params, source, target, source_neighbors, target_neighbors, cascades):
    def of(params, source, target):
        return total(
            params,
            prepare(source, neighbors=source_neighbors),
            prepare(target, neighbors=target_neighbors),
            cascades,
        )

    return jax.value_and_grad(of, (0, 1, 2))(params, source, target)


def test_detached_motion_stops_gradients_between_cascades(params):
    # then the gradient of a second cascade is that of a registration from where the first ended
    source, target = (cloud("random", seed, N, True) for seed in (0, 1))
    settings = Settings(neighbors=K, detach_motion=True)
    source, target = (prepare(points, settings=settings) for points in (source, target))
    first = register(params, source, target, iterations=1, settings=settings).transform

    def twice(params):
        found = register(params, source, target, iterations=1, cascades=2, settings=settings)
        return jnp.sum(found.transform[0])

    def again(params):
        moved = moved_by(first, source)
        found = register(params, moved, target, iterations=1, settings=settings)
        return jnp.sum((found.transform @ first)[0])

    found, wanted = (jax.jit(jax.grad(of))(params) for of in (twice, again))
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5)


def test_detached_motion_stops_gradients_between_iterations(params):
    source, target = cloud("random", 0, N, True), cloud("random", 1, M, True)
    settings = Settings(neighbors=K, detach_motion=True)

    def last(params):
        found = register(params, source, target, iterations=2, settings=settings)
        return jnp.sum(found.transform[0]), found.transforms

    gradient, transforms = jax.jit(jax.grad(last, has_aux=True))(params)

    # beta and alpha of iteration 0 reach the last transform through the motion alone
    of_annealing = np.abs(gradient["annealing"]["out"]["bias"])
    assert of_annealing[0] == of_annealing[5] == 0
    assert of_annealing[1] > 0 and of_annealing[6] > 0
    plain = register(params, source, target, iterations=2, settings=SMALL)
    np.testing.assert_allclose(transforms, plain.transforms, atol=5e-6)  # two programs round apart
