"""Estimated normals: those of known surfaces, pointing outward, and moving with the cloud."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import pieces
from scipy.spatial.transform import Rotation

from cfr_jax.geometry.neighbors import nearest_on_host
from cfr_jax.geometry.normals import estimate_normals

estimate = jax.jit(estimate_normals)


def ball(seed=0, n=400):
    directions = np.random.default_rng(seed).normal(size=(n, 3))
    return (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)


def normals_of(points, k=12, mask=None):
    neighbors = nearest_on_host(points, k)
    return np.asarray(estimate(jnp.asarray(points), jnp.asarray(neighbors), mask))


def test_normals_of_a_ball_are_its_radii():
    points = ball() + np.float32([3, 0, 0])

    cosines = np.sum(normals_of(points) * ball(), axis=1)

    assert np.degrees(np.arccos(np.clip(cosines, -1, 1))).max() < 15
    assert np.median(cosines) > 0.999


def test_normals_of_a_plane_are_exact():
    rng = np.random.default_rng(1)
    turn = Rotation.random(random_state=rng).as_matrix()
    points = ((rng.normal(size=(100, 3)) * [1, 1, 0]) @ turn.T).astype(np.float32)

    found = normals_of(points)

    np.testing.assert_allclose(np.abs(found @ turn[:, 2]), 1, atol=1e-5)


def test_a_normal_is_the_least_spread_of_its_weighted_neighborhood():
    # the point itself counts one, a neighbor exp(-d^2 / 2 s^2), s 0.45 of the root mean square
    # distance: what the weights were trained on
    points = np.random.default_rng(6).normal(size=(40, 3)).astype(np.float32)
    neighbors = nearest_on_host(points, 9)

    found = normals_of(points, 9)

    for point, around, normal in zip(points, neighbors, found, strict=True):
        offset = np.vstack([np.zeros(3), points[around].astype(np.float64) - point])
        square = (offset**2).sum(1)
        weight = np.exp(-square / (2 * 0.45**2 * square[1:].mean()))
        wanted = np.linalg.eigh(np.cov(offset.T, aweights=weight, ddof=0))[1][:, 0]
        np.testing.assert_allclose(np.abs(normal @ wanted), 1, atol=1e-5)


def test_normals_turn_away_from_the_centroid_of_the_valid_points_however_many_are_not():
    points = ball(7, 100) + np.float32([3, 0, 0])
    padded = np.concatenate([points, np.zeros((300, 3), np.float32)])
    neighbors = np.concatenate([nearest_on_host(points, 12), np.zeros((300, 12), np.int32)])

    found = estimate(jnp.asarray(padded), jnp.asarray(neighbors), jnp.arange(400) < 100)

    assert (np.sum(found[:100] * ball(7, 100), axis=1) > 0.5).all()


def test_normals_move_with_the_cloud():
    turn = Rotation.random(random_state=2).as_matrix()
    points = ball(2)
    moved = (points @ turn.T + [0.5, -1, 2]).astype(np.float32)

    np.testing.assert_allclose(normals_of(moved), normals_of(points) @ turn.T, atol=1e-4)


def test_padding_changes_no_normal_and_has_zero_normals():
    points = ball(3, 100)
    neighbors = nearest_on_host(points, 12)
    padded = np.concatenate([points, np.full((20, 3), 77, np.float32)])
    padded_neighbors = np.concatenate([neighbors, np.zeros((20, 12), np.int32)])

    found = estimate(jnp.asarray(padded), jnp.asarray(padded_neighbors), jnp.arange(120) < 100)

    np.testing.assert_allclose(found[:100], normals_of(points), atol=1e-5)
    assert not found[100:].any()


def total(points, neighbors, pull):
    return jnp.sum(estimate_normals(points, neighbors) * pull)


gradient = jax.jit(jax.grad(total))

CLOUDS = {
    "random": lambda rng: rng.normal(size=(20, 3)),
    "planar": lambda rng: rng.normal(size=(20, 3)) * [1, 1, 0],
    "collinear": lambda rng: rng.normal(size=(20, 1)) * [[1, 2, 3]],
    "one point": lambda rng: np.ones((20, 3)),
    "pairs": lambda rng: np.repeat(rng.normal(size=(10, 3)), 2, axis=0),
    "tiny": lambda rng: rng.normal(size=(20, 3)) * 1e-6,
    "huge": lambda rng: rng.normal(size=(20, 3)) * 1e6,
}


@pytest.mark.parametrize("name", CLOUDS)
def test_normals_are_unit_with_finite_gradients_for_any_cloud(name):
    rng = np.random.default_rng(4)
    points = CLOUDS[name](rng).astype(np.float32)
    neighbors = jnp.asarray(nearest_on_host(points, 6))
    pull = jnp.asarray(rng.normal(size=(20, 3)), jnp.float32)

    found = estimate(jnp.asarray(points), neighbors)

    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)
    assert np.isfinite(gradient(jnp.asarray(points), neighbors, pull)).all()


def test_gradients_match_finite_differences(x64):
    rng = np.random.default_rng(5)
    points, change, pull = (jnp.asarray(a) for a in rng.normal(size=(3, 20, 3)))
    neighbors = jnp.asarray(pieces.nearest_neighbors(np.asarray(points), 6).astype(np.int32))
    step = 1e-6

    derivative = jnp.sum(gradient(points, neighbors, pull) * change)

    ahead, behind = (jax.jit(total)(points + s * step * change, neighbors, pull) for s in (1, -1))
    np.testing.assert_allclose(derivative, (ahead - behind) / (2 * step), rtol=1e-5)
