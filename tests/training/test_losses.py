"""The training loss against its formula in numpy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import authors, cfr, clouds, pieces

from cfr_jax.networks.cfr.iterations import unroll
from cfr_jax.networks.inputs import Settings, prepare
from cfr_jax.training.losses import correspondence_loss, pair_loss
from cfr_jax.weights.conversion import from_state_dict

SMALL = Settings(neighbors=6)
N, M, L = 24, 28, 2


@functools.cache
def measured(correspondence_weight):
    state = authors.random_state_dict(0, iterations=L)
    pair = clouds.random_pair(0, N, M)
    source, target = (
        prepare(jnp.asarray(np.concatenate(part, axis=1)), settings=SMALL)
        for part in ((pair.x, pair.nx), (pair.y, pair.ny))
    )

    @jax.jit
    def loss_of(params, source, target, truth):
        steps = unroll(params, source, target, SMALL)
        return pair_loss(steps, source, target, truth, correspondence_weight=correspondence_weight)

    truth = jnp.asarray(pair.transform, jnp.float32)
    loss = loss_of(from_state_dict(state), source, target, truth)
    trace = cfr.trace(state, *pair[:4], iterations=L, neighbors=6)
    return loss, trace, pair


def cross_entropy(log_affinity, square):
    """Row by row and column by column, as the docstring says it."""

    def of_rows(log_affinity, square):
        total = 0.0
        for logits, near in zip(log_affinity, square, strict=True):
            close = np.where(near < 0.01, np.exp(-near / (2 * 0.035**2)), 0)
            target = np.append(close / max(close.sum(), 1e-12) * close.max(), 1 - close.max())
            logits = np.append(logits, 0.0)
            total -= target @ (logits - np.logaddexp.reduce(logits))
        return total / len(log_affinity)

    return (of_rows(log_affinity, square) + of_rows(log_affinity.T, square.T)) / 2


def test_the_pose_term_is_the_papers():
    loss, trace, pair = measured(0.05)

    there = pieces.move(pair.transform, pair.x)
    pose = 0.0
    for i in range(L):
        distance = np.abs(pieces.move(trace.transforms[i], pair.x) - there).mean()
        slack = (1 - trace.matches[i].sum(axis=0)).mean() + (1 - trace.weights[i]).mean()
        pose += 0.5 ** (L - 1 - i) * (distance + 0.01 * slack)
    np.testing.assert_allclose(loss.pose, pose, rtol=1e-5)


def test_the_correspondence_term_is_a_cross_entropy_with_slack():
    loss, trace, pair = measured(0.05)

    there = pieces.move(pair.transform, pair.x)
    square = cfr.squared_distances(there, pair.y.astype(np.float64))
    assert (square.min(axis=1) < 0.01).any() and (square.min(axis=1) > 0.01).any()
    wanted = sum(
        0.5 ** (L - 1 - i) * cross_entropy(trace.log_affinities[i], square) for i in range(L)
    )
    np.testing.assert_allclose(loss.correspondence, wanted, rtol=1e-5)
    np.testing.assert_allclose(loss.total, loss.pose + 0.05 * loss.correspondence, rtol=1e-6)


def test_without_weight_there_is_no_correspondence_term():
    loss, _, _ = measured(0.0)

    assert loss.correspondence == 0 and loss.total == loss.pose


def test_errors_are_those_of_each_iteration():
    loss, trace, pair = measured(0.05)

    left = np.linalg.inv(pair.transform) @ trace.transforms
    cosine = (np.trace(left[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    np.testing.assert_allclose(loss.rotation_error, np.degrees(np.arccos(cosine)), rtol=1e-3)
    np.testing.assert_allclose(
        loss.translation_error, np.linalg.norm(left[:, :3, 3], axis=1), rtol=1e-4
    )
    np.testing.assert_allclose(loss.beta, trace.beta[:L], rtol=1e-5)
    np.testing.assert_allclose(loss.alpha, trace.alpha[:L], rtol=1e-5)


@pytest.mark.parametrize("scale", [1.0, 200.0, 1e4])
def test_the_correspondence_term_has_finite_gradients_far_from_sense(scale):
    rng = np.random.default_rng(1)
    log_affinity = jnp.asarray(scale * rng.normal(size=(5, 7)), jnp.float32)
    near, far = jnp.full((5, 7), 1e-4), jnp.full((5, 7), 4.0)

    for square in (near, far):
        value, gradients = jax.value_and_grad(correspondence_loss, (0, 1))(log_affinity, square)

        assert np.isfinite(value)
        assert all(np.isfinite(gradient).all() for gradient in gradients)
        np.testing.assert_allclose(
            value, cross_entropy(np.float64(log_affinity), np.float64(square)), rtol=1e-5
        )
