"""What DCP, FMR and RGM are made of, piece by piece: norms, Sinkhorn, steps, assignments."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import clouds, peer_authors, pieces
from oracle import fmr as fmr_oracle
from oracle import rgm as rgm_oracle

from cfr_jax.geometry import rigid
from cfr_jax.networks.inputs import Cloud
from cfr_jax.networks.peers import assignment, fmr
from cfr_jax.networks.peers.batch_norm import MOMENTUM, PAIRS, BatchNorm, apply_in_training
from cfr_jax.networks.peers.gauss_newton import jacobian, steps_of
from cfr_jax.networks.sinkhorn.plan import log_plan
from cfr_jax.weights.conversion import from_state_dict

# --- batch norm ---


def test_a_training_normalizes_by_the_batch_and_keeps_a_moving_average():
    # given three pairs, the last row of each padded
    rng = np.random.default_rng(0)
    x = rng.normal(2, 3, size=(3, 5, 4)).astype(np.float32)
    mask = np.arange(5) < 4
    valid = x[:, :4].reshape(-1, 4)
    module = BatchNorm(training=True)
    start = {"scale": 1.5, "shift": 0.5, "running_mean": 0.2, "running_variance": 0.7}
    params = {name: jnp.full(4, value, jnp.float32) for name, value in start.items()}

    # when
    def loss(params, x):
        out, pull = apply_in_training(module, params, x, jnp.asarray(mask))
        return pull, out

    slope = jax.vmap(jax.value_and_grad(loss, has_aux=True), (None, 0), axis_name=PAIRS)
    (value, out), gradient = slope(params, jnp.asarray(x))

    # then
    wanted = 1.5 * (valid - valid.mean(0)) / np.sqrt(valid.var(0) + 1e-5) + 0.5
    np.testing.assert_allclose(np.asarray(out)[:, :4].reshape(-1, 4), wanted, atol=1e-5)
    assert not np.any(value)
    for name, seen in (("running_mean", valid.mean(0)), ("running_variance", valid.var(0, ddof=1))):
        kept = params[name] - MOMENTUM * gradient[name].mean(0)
        np.testing.assert_allclose(kept, 0.9 * start[name] + 0.1 * seen, rtol=1e-5)
    for name in ("scale", "shift"):
        assert not np.any(gradient[name])


# --- Sinkhorn ---


@pytest.mark.parametrize("scale", [1, 30])
@pytest.mark.parametrize("slack", [True, False])
def test_twenty_passes_are_those_in_log_space(slack, scale):
    values = scale * np.random.default_rng(0).normal(size=(11, 14))

    found = log_plan(jnp.float32(values), passes=20, slack=slack)

    reference = pieces.sinkhorn_log if slack else rgm_oracle.sinkhorn_without_slack
    np.testing.assert_allclose(np.exp(found), reference(values, 20), atol=1e-5)


@pytest.mark.parametrize("slack", [True, False])
def test_the_gradient_of_twenty_passes_is_its_finite_difference(x64, slack):
    rng = np.random.default_rng(0)
    values, towards, pull = (jnp.asarray(rng.normal(size=(5, 7))) for _ in range(3))

    def total(values):
        return jnp.sum(pull * jnp.exp(log_plan(3 * values, passes=20, slack=slack)))

    along = jnp.sum(jax.grad(total)(values) * towards)
    either = [total(values + sign * 1e-6 * towards) for sign in (1, -1)]
    np.testing.assert_allclose(along, (either[0] - either[1]) / 2e-6, rtol=1e-6)


# --- FMR's steps ---


@pytest.fixture
def encoder(x64):
    """Of a centered cloud: the points, what encodes them, and the state dict of that."""
    state = peer_authors.random_fmr_state_dict(0)
    with jax.enable_x64(False):
        params = from_state_dict(state)
    params = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), params)
    network = fmr.FMR().bind({"params": params})
    points = clouds.random_pair(2, 50, 50).y.astype(np.float64)
    return jnp.asarray(points - points.mean(0)), network.encode, state


def test_the_jacobian_is_that_of_central_differences(encoder):
    points, encode, state = encoder
    small = 1e-5

    _, slope = jax.jit(lambda p: jacobian(encode, p, jnp.full(6, small)))(points)

    for k in range(6):
        either = [
            fmr_oracle.encode(
                state,
                pieces.move(fmr_oracle.motion(sign * small * np.eye(6)[k]), np.asarray(points)),
            )
            for sign in (1, -1)
        ]
        central = (either[0] - either[1]) / (2 * small)
        # one-sided: apart by the second derivative times the step, and where a maximum changes
        assert np.median(np.abs(slope[:, k] - central)) < 1e-4
        assert np.mean(np.abs(slope[:, k] - central) < 1e-3) > 0.95


def test_steps_go_back_what_the_cloud_was_moved(encoder):
    points, encode, _ = encoder
    motion = rigid.exp(jnp.array([0.05, -0.04, 0.06, 0.02, -0.03, 0.01]))

    def solve(points):
        wanted, slope = jacobian(encode, points, jnp.full(6, 1e-3))
        return steps_of(encode, rigid.apply(rigid.inverse(motion), points), wanted, slope, 10)

    found = jax.jit(solve)(points)

    away = [float(jnp.linalg.norm(each - motion)) for each in (jnp.eye(4), *found)]
    assert away[1] < away[0] / 2  # the first step goes most of the way
    assert away[-1] < 1e-3


def test_a_step_that_nothing_determines_is_short():
    # given a vector that does not change with three of the twists
    slope = jnp.pad(jnp.eye(3), ((0, 0), (3, 0)))
    points = jnp.eye(3)

    found = steps_of(lambda p: jnp.mean(p, axis=0), points, jnp.full(3, 0.5), slope, 8)

    np.testing.assert_allclose(found[-1, :3, :3], np.eye(3), atol=1e-6)
    np.testing.assert_allclose(found[-1, :3, 3], np.full(3, 0.5 - 1 / 3), atol=1e-5)


# --- RGM's assignments ---


@pytest.mark.parametrize("seed", range(4))
def test_true_assignments_are_those_of_the_description(seed):
    # given clouds close enough for every rule to have its say
    rng = np.random.default_rng(seed)
    source = rng.uniform(-0.12, 0.12, size=(40, 3)).astype(np.float32)
    target = rng.uniform(-0.12, 0.12, size=(37, 3)).astype(np.float32)
    truth = fmr_oracle.motion(rng.normal(size=6) / 3)
    here = pieces.move(np.linalg.inv(truth), source)

    found = assignment.true_assignment(cloud(here), cloud(target), jnp.float32(truth))

    wanted = rgm_oracle.true_assignment(source.astype(np.float64), target.astype(np.float64))
    np.testing.assert_array_equal(found, wanted)
    assert found.sum(0).max() == found.sum(1).max() == 1


def test_copied_points_are_their_own_partners():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, size=(30, 3)).astype(np.float32)
    order = rng.permutation(30)

    found = assignment.true_assignment(cloud(points[order]), cloud(points), jnp.eye(4))

    np.testing.assert_array_equal(found, np.eye(30)[order])


def test_an_assignment_leaves_out_what_is_found_less_than_half():
    soft = np.array([[0.6, 0.2, 0.0], [0.5, 0.3, 0.1], [0.1, 0.1, 0.1]], np.float32)

    found = jax.jit(lambda plan: assignment.assign(jnp.log(plan), 0.5))(jnp.asarray(soft))

    np.testing.assert_array_equal(found, rgm_oracle.assigned(soft, 0.5))
    assert found[2].sum() == 0 and found[:, 2].sum() == 0


def test_without_partners_nothing_is_moved():
    points = cloud(np.random.default_rng(0).normal(size=(5, 3)))

    np.testing.assert_array_equal(
        assignment.motion_of(jnp.zeros((5, 5)), points, points), np.eye(4)
    )


def cloud(points):
    points = jnp.float32(points)
    return Cloud(points, jnp.zeros_like(points), jnp.zeros((len(points), 1), jnp.int32))
