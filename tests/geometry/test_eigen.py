"""Eigenvectors compared with LAPACK's, and the derivative of the least direction."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cfr_jax.geometry.eigen import (
    SQUARINGS,
    SWEEPS,
    leading_eigenvector,
    least_direction,
    solve_positive,
    symmetric_eigen,
)

least_slope = jax.jit(jax.jacrev(least_direction))
solve = jax.jit(jax.vmap(symmetric_eigen))


def symmetric(rng, values, count=50):
    """Matrices with the given eigenvalues and random eigenvectors."""
    basis = np.linalg.qr(rng.normal(size=(count, len(values), len(values))))[0]
    return np.einsum("bij,j,bkj->bik", basis, values, basis).astype(np.float32)


@pytest.mark.parametrize(
    "values",
    [
        (3.0, 2.0, 1.0),
        (1.0, 1.0, 0.2),
        (1.0, 0.2, 0.2),
        (1.0, 1.0, 1.0),
        (1.0, 0.0, 0.0),
        (1.0, 1.0, 0.0),
        (0.0, 0.0, 0.0),
        (2.0, -1.0, -2.0),
        (1.0, 1e-4, 1e-6),
        (1.0, -1.0, -1.0, 1.0),
        (3.0, 1e-3, -2.0, -1.0),
        (1.0, 1.0, 1.0, -3.0),
    ],
)
@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_eigenvectors_rebuild_the_matrix(values, scale):
    matrices = symmetric(np.random.default_rng(0), np.array(values)) * np.float32(scale)

    found, vectors = solve(jnp.asarray(matrices))

    rebuilt = np.einsum("bij,bj,bkj->bik", vectors, found, vectors)
    np.testing.assert_allclose(rebuilt, matrices, atol=3e-6 * scale)
    identity = np.broadcast_to(np.eye(len(values)), rebuilt.shape)
    np.testing.assert_allclose(
        np.einsum("bji,bjk->bik", vectors, vectors), identity, rtol=0, atol=3e-6
    )
    wanted = np.broadcast_to(np.sort(values) * scale, found.shape)
    np.testing.assert_allclose(np.sort(found, axis=1), wanted, atol=3e-6 * scale)


def random_symmetric(size, count=500):
    matrices = np.random.default_rng(1).normal(size=(count, size, size)).astype(np.float32)
    return jnp.asarray(matrices + matrices.transpose(0, 2, 1))


@pytest.mark.parametrize("size", [3, 4])
def test_the_last_sweep_changes_no_float32_result_and_the_first_ones_do(size):
    matrices = random_symmetric(size)

    values, earlier, early = (
        jax.jit(jax.vmap(functools.partial(symmetric_eigen, sweeps=sweeps)))(matrices)[0]
        for sweeps in (SWEEPS, SWEEPS - 1, 1)
    )

    np.testing.assert_allclose(values, earlier, rtol=0, atol=1e-5)
    assert np.abs(values - early).max() > 0.1


def shares(matrices, **options):
    """Components of the leading eigenvectors along each float64 eigenvector, ascending."""
    leading = jax.vmap(functools.partial(leading_eigenvector, **options))
    found = np.asarray(jax.jit(leading)(jnp.asarray(matrices, jnp.float32)), np.float64)
    vectors = np.linalg.eigh(np.asarray(matrices, np.float64))[1]
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    return np.abs(np.einsum("bij,bi->bj", vectors, found))


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize(
    ("values", "several"),
    [
        ((3.0, 1.0, -1.0, -3.0), 1),
        ((3.0, -1.0, -1.0, -1.0), 1),
        ((1.0, 0.99, 0.0, -1.99), 1),
        ((1.0, 1.0, -1.0, -1.0), 2),
        ((1.0, 1.0, 1.0, -3.0), 3),
    ],
)
def test_the_leading_eigenvector_lies_among_those_of_the_largest_eigenvalue(values, several, scale):
    matrices = symmetric(np.random.default_rng(4), np.array(values)) * np.float32(scale)

    others = shares(matrices)[:, : 4 - several]

    np.testing.assert_allclose(others, 0, atol=1e-4 if 0.99 in values else 2e-6)


def test_the_leading_eigenvector_of_zero_is_the_first_axis():
    np.testing.assert_array_equal(leading_eigenvector(jnp.zeros((4, 4))), [1, 0, 0, 0])


def test_squarings_tell_apart_eigenvalues_that_differ_by_a_hundred_thousandth():
    matrices = symmetric(np.random.default_rng(5), np.array([1.0, 1 - 1e-5, -1.0, -1.0]))
    lost = lambda found: np.max(found[:, 2] ** 2)  # noqa: E731

    assert lost(shares(matrices)) < 0.05
    assert lost(shares(matrices, squarings=SQUARINGS // 2)) > 0.2


def test_the_least_direction_is_the_one_from_lapack():
    rng = np.random.default_rng(2)
    factors = rng.normal(size=(100, 5, 3)).astype(np.float32)
    covariances = factors.transpose(0, 2, 1) @ factors

    found = jax.jit(jax.vmap(least_direction))(jnp.asarray(covariances))

    wanted = np.linalg.eigh(covariances.astype(np.float64))[1][..., 0]
    np.testing.assert_allclose(np.abs(np.sum(found * wanted, axis=1)), 1, atol=1e-5)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_the_derivative_of_the_least_direction_matches_finite_differences(x64, scale):
    rng = np.random.default_rng(3)
    factor = rng.normal(size=(5, 3))
    covariance = jnp.asarray(factor.T @ factor) * scale
    change = rng.normal(size=(3, 3))
    change = jnp.asarray(change + change.T) * scale
    step = 1e-6

    least = jax.jit(least_direction)
    _, derivative = jax.jvp(least, (covariance,), (change,))

    ahead, behind = (least(covariance + sign * step * change) for sign in (1, -1))
    np.testing.assert_allclose(derivative, (ahead - behind) / (2 * step), atol=1e-7)


@pytest.mark.parametrize(
    "diagonal", [(0, 0, 0), (1, 0, 0), (1, 1, 0), (1, 1, 1), (1e-30, 1e-30, 1e-30), (1e30, 1, 1)]
)
def test_the_least_direction_has_a_finite_derivative_everywhere(diagonal):
    covariance = jnp.diag(jnp.array(diagonal, jnp.float32))

    gradient = least_slope(covariance)

    assert np.isfinite(gradient).all()
    np.testing.assert_allclose(np.linalg.norm(least_direction(covariance)), 1, atol=1e-6)


@pytest.mark.parametrize("smallest", [1.0, 1e-3, 1e-6])
def test_a_positive_system_is_solved_as_well_as_by_lapack(smallest):
    values = np.geomspace(1, smallest, 6)
    matrices = symmetric(np.random.default_rng(6), values, count=200)
    right = np.random.default_rng(7).normal(size=(200, 6)).astype(np.float32)

    found, theirs = (
        jax.jit(jax.vmap(solver))(jnp.asarray(matrices), jnp.asarray(right))
        for solver in (solve_positive, jnp.linalg.solve)
    )

    wanted = np.linalg.solve(matrices.astype(np.float64), right[..., None].astype(np.float64))
    off, theirs_off = (np.linalg.norm(x - wanted[..., 0], axis=1) for x in (found, theirs))
    length = np.linalg.norm(wanted[..., 0], axis=1)
    assert np.median(off / length) < 1.2 * np.median(theirs_off / length) + 1e-7
    assert np.max(off / length) < 1.5 * np.max(theirs_off / length) + 1e-6
