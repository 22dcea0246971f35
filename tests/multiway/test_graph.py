"""Pose graphs: known poses are recovered from noisy edges; the Jacobian and covariances are
right."""

from __future__ import annotations

import numpy as np
import pytest
from multiway_samples import distances, first_only, graph_of, some_poses
from scipy.stats import chi2

from cfr_jax.geometry import twists
from cfr_jax.multiway.pose_graph import graph


@pytest.fixture
def poses() -> np.ndarray:
    return some_poses(7, seed=1)


def test_exact_edges_give_the_poses_from_afar(poses):
    # given
    edges = graph_of(poses, noise=0.0)
    start = poses @ twists.exp(np.random.default_rng(0).normal(0, 0.4, (7, 6)))
    start[0] = poses[0]
    # when
    found = graph.solve(edges, start, first_only(7))
    # then
    np.testing.assert_allclose(found, poses, atol=1e-7)


def test_noisy_edges_together_are_better_than_a_chain(poses):
    edges = graph_of(poses, noise=0.02, seed=5)
    found = graph.solve(edges, poses, first_only(7))
    chain = edges.take(np.flatnonzero(np.abs(edges.source - edges.target) == 1))
    alone = graph.solve(chain, poses, first_only(7))
    assert distances(found, poses).mean() < 0.7 * distances(alone, poses).mean()


def test_the_answer_is_where_no_small_step_is_better(poses):
    # given
    edges = graph_of(poses, noise=0.05, seed=6)
    found = graph.solve(edges, poses, first_only(7))
    least = graph.chi_squares(edges, found).sum()
    # when
    steps = np.random.default_rng(1).normal(0, 1e-3, (20, 7, 6))
    steps[:, 0] = 0
    others = [graph.chi_squares(edges, found @ twists.exp(step)).sum() for step in steps]
    # then
    assert min(others) > least


def test_the_jacobian_is_that_of_finite_differences(poses):
    # given: far from the answer, and parameters that are not zero
    edges = graph_of(poses, noise=0.3, seed=2)
    fixed = first_only(7)
    whitening = np.linalg.cholesky(edges.information).swapaxes(-1, -2)
    steps = np.random.default_rng(4).normal(0, 0.2, 36)
    # when
    found = graph._jacobian(steps, edges, poses, fixed, whitening).toarray()
    # then
    size = 1e-6
    columns = [
        (
            graph._whitened(steps + size * axis, edges, poses, fixed, whitening)
            - graph._whitened(steps - size * axis, edges, poses, fixed, whitening)
        )
        / (2 * size)
        for axis in np.eye(36)
    ]
    np.testing.assert_allclose(found, np.stack(columns, axis=1), atol=2e-6 * np.abs(found).max())


def test_the_covariance_is_that_of_repeated_measurements(poses):
    # given: the poses solved from many draws of the noise that the information claims
    fixed = first_only(7)
    squares = []
    for seed in range(150):
        edges = graph_of(poses, noise=0.01, seed=seed)
        found = graph.solve(edges, poses, fixed)
        covariance = graph.covariances(edges, found, fixed)[1:]
        off = twists.log(twists.inverse(found) @ poses)[1:]
        squares.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off))
    # then: six squared standard deviations in the mean, a chi square distribution around that
    squares = np.stack(squares)
    np.testing.assert_allclose(squares.mean(axis=0), 6.0, rtol=0.2)
    np.testing.assert_allclose((squares < chi2.ppf(0.9, 6)).mean(), 0.9, atol=0.05)


def test_scans_that_nothing_connects_stay(poses):
    edges = graph_of(poses, noise=0.0).take(np.array([], np.int64))
    np.testing.assert_array_equal(graph.solve(edges, poses, np.ones(7, bool)), poses)
