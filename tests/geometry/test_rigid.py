"""Rigid motions compared with numpy's SVD and scipy, and derivatives where an SVD has none."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import pieces
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from cfr_jax.geometry import rigid

nearest = jax.jit(jax.vmap(rigid.nearest_rotation))
nearest_slope = jax.jit(jax.vmap(jax.jacrev(rigid.nearest_rotation)))
exp_slope, log_slope = (jax.jit(jax.vmap(jax.jacrev(f))) for f in (rigid.exp, rigid.log))
exp, log = jax.jit(jax.vmap(rigid.exp)), jax.jit(jax.vmap(rigid.log))


def by_svd(matrix):
    """The proper rotation nearest to a matrix, in float64."""
    u, _, vt = np.linalg.svd(np.asarray(matrix, np.float64))
    u[..., 2] *= np.linalg.det(u @ vt)[..., None]
    return u @ vt


def random_motions(rng, count, reach=1.0):
    transforms = np.tile(np.eye(4), (count, 1, 1))
    transforms[:, :3, :3] = Rotation.random(count, random_state=rng).as_matrix()
    transforms[:, :3, 3] = rng.normal(size=(count, 3)) * reach
    return transforms


def with_singular_values(rng, values, count=200):
    u, v = (np.linalg.qr(rng.normal(size=(count, 3, 3)))[0] for _ in range(2))
    u, v = (q * np.linalg.det(q)[:, None, None] for q in (u, v))
    return np.einsum("bij,j,bkj->bik", u, np.array(values), v)


def assert_proper(rotations, atol=5e-6):
    rotations = np.asarray(rotations, np.float64)
    identity = np.broadcast_to(np.eye(3), rotations.shape)
    np.testing.assert_allclose(rotations @ np.swapaxes(rotations, -1, -2), identity, atol=atol)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=atol)


@pytest.mark.parametrize("scale", [1e-20, 1e-6, 1.0, 1e6, 1e20])
@pytest.mark.parametrize(
    "values", [(3.0, 2.0, 1.0), (3.0, 2.0, -1.0), (1.0, 1.0, 1.0), (1.0, 0.5, 0.0), (1.0, 1.0, 0.0)]
)
def test_the_nearest_rotation_matches_an_svd(values, scale):
    # reflections (a negative last value), planar clouds (a zero one), repeated values
    matrices = with_singular_values(np.random.default_rng(0), values) * scale

    found = nearest(jnp.asarray(matrices, jnp.float32))

    np.testing.assert_allclose(found, by_svd(matrices), atol=2e-5)


@pytest.mark.parametrize("values", [(1.0, 0.0, 0.0), (1.0, 1.0, -1.0), (1.0, 0.5, -0.5), (0, 0, 0)])
@pytest.mark.parametrize("scale", [1e-20, 1.0, 1e20])
def test_if_the_nearest_rotation_is_not_unique_one_of_them_is_returned(values, scale):
    matrices = with_singular_values(np.random.default_rng(1), values) * scale

    found = np.asarray(nearest(jnp.asarray(matrices, jnp.float32)), np.float64)

    assert_proper(found)
    reached = np.einsum("bij,bij->b", found, matrices)
    np.testing.assert_allclose(reached, scale * np.sum(values), atol=5e-6 * scale)


def test_the_nearest_rotation_of_zero_is_the_identity():
    np.testing.assert_array_equal(rigid.nearest_rotation(jnp.zeros((3, 3))), np.eye(3))


@pytest.mark.parametrize("values", [(3.0, 2.0, 1.0), (3.0, 2.0, -1.0), (1.0, 1.0, 1.0)])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_the_derivative_of_the_nearest_rotation_matches_finite_differences(x64, values, scale):
    rng = np.random.default_rng(2)
    matrix = jnp.asarray(with_singular_values(rng, values, 1)[0]) * scale
    change = jnp.asarray(rng.normal(size=(3, 3))) * scale
    step = 1e-6

    nearest = jax.jit(rigid.nearest_rotation)
    _, derivative = jax.jvp(nearest, (matrix,), (change,))

    ahead, behind = (nearest(matrix + s * step * change) for s in (1, -1))
    np.testing.assert_allclose(derivative, (ahead - behind) / (2 * step), atol=1e-7)


@pytest.mark.parametrize(
    "values", [(1, 1, 1), (1, 1, -1), (1, 0.5, -0.5), (1, 1, 0), (1, 0, 0), (0, 0, 0)]
)
@pytest.mark.parametrize("scale", [1e-20, 1.0, 1e18])
def test_the_nearest_rotation_has_a_finite_gradient_everywhere(values, scale):
    matrices = with_singular_values(np.random.default_rng(3), values, 5) * scale
    matrices = np.concatenate([matrices, [np.diag(values) * scale]])

    gradients = nearest_slope(jnp.asarray(matrices, jnp.float32))

    assert np.isfinite(gradients).all()


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_fitting_recovers_a_motion(scale):
    rng = np.random.default_rng(4)
    source = rng.normal(size=(40, 3))
    transform = random_motions(rng, 1)[0]
    target = pieces.move(transform, source)
    weights = rng.uniform(0.5, 1, 40)
    target[:5], weights[:5] = 99, 0  # points without weight have no influence

    found = rigid.fit_rigid(
        *(jnp.asarray(part, jnp.float32) for part in (source * scale, target * scale, weights))
    )

    np.testing.assert_allclose(found[:3, :3], transform[:3, :3], atol=5e-6)
    np.testing.assert_allclose(found[:3, 3], transform[:3, 3] * scale, atol=5e-6 * scale)


def test_a_fit_to_scattered_points_matches_the_reference():
    rng = np.random.default_rng(5)
    source, target = rng.normal(size=(2, 30, 3))
    for weights in (rng.uniform(0, 1, 30), rng.uniform(0, 1e-5, 30)):
        found = rigid.fit_rigid(
            *(jnp.asarray(part, jnp.float32) for part in (source, target, weights))
        )

        np.testing.assert_allclose(found, pieces.procrustes(source, target, weights), atol=5e-5)


CLOUDS = {
    "random": lambda rng: rng.normal(size=(9, 3)),
    "planar": lambda rng: rng.normal(size=(9, 3)) * [1, 1, 0],
    "collinear": lambda rng: rng.normal(size=(9, 1)) * [[1, 2, 3]],
    "one point": lambda rng: np.ones((9, 3)),
    "zero": lambda rng: np.zeros((9, 3)),
    "tiny": lambda rng: rng.normal(size=(9, 3)) * 1e-6,
    "huge": lambda rng: rng.normal(size=(9, 3)) * 1e6,
}


@jax.jit
@functools.partial(jax.grad, argnums=(0, 1, 2), has_aux=True)
def pulled(source, target, weights, pull):
    transform = rigid.fit_rigid(source, target, weights)
    return jnp.sum(transform * pull), transform


@pytest.mark.parametrize("weight", [0.0, 1e-20, 0.5])
@pytest.mark.parametrize("name", CLOUDS)
def test_a_fit_is_proper_with_finite_gradients_for_any_cloud(name, weight):
    source, target = (CLOUDS[name](np.random.default_rng(seed)) for seed in (6, 7))
    arguments = [jnp.asarray(part, jnp.float32) for part in (source, target, np.full(9, weight))]
    pull = jnp.asarray(np.random.default_rng(8).normal(size=(4, 4)), jnp.float32)

    gradients, found = pulled(*arguments, pull)

    assert np.isfinite(found).all()
    assert_proper(found[:3, :3])
    assert all(np.isfinite(gradient).all() for gradient in gradients)


def test_the_derivative_of_a_fit_matches_finite_differences(x64):
    rng = np.random.default_rng(9)
    at = tuple(jnp.asarray(part) for part in (*rng.normal(size=(2, 9, 3)), rng.uniform(size=9)))
    towards = tuple(jnp.asarray(rng.normal(size=part.shape)) for part in at)
    step = 1e-6

    fit = jax.jit(rigid.fit_rigid)
    _, derivative = jax.jvp(fit, at, towards)

    ahead, behind = (
        fit(*(a + sign * step * d for a, d in zip(at, towards, strict=True))) for sign in (1, -1)
    )
    np.testing.assert_allclose(derivative, (ahead - behind) / (2 * step), atol=1e-6)


def twists(angle, count=50):
    rng = np.random.default_rng(10)
    turns = rng.normal(size=(count, 3))
    turns *= angle / np.linalg.norm(turns, axis=1, keepdims=True)
    return np.concatenate([turns, rng.normal(size=(count, 3))], axis=1)


def exponentials(given):
    """What scipy makes of twists."""
    generators = np.zeros((len(given), 4, 4))
    for row, (x, y, z) in enumerate(given[:, :3]):
        generators[row, :3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    generators[:, :3, 3] = given[:, 3:]
    return np.stack([expm(generator) for generator in generators])


ANGLES = [0.0, 1e-8, 1e-4, 0.009, 0.011, 0.5, 2.0, 3.0, np.pi - 1e-3, np.pi - 1e-6]


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_is_the_matrix_exponential_and_log_inverts_it(angle):
    given = twists(angle)
    wanted = exponentials(given)

    found = exp(jnp.asarray(given, jnp.float32))
    back = log(found)

    np.testing.assert_allclose(found, wanted, atol=2e-6)
    # near a half turn, the sign of the axis is not determined
    np.testing.assert_allclose(exp(back), wanted, atol=1e-5)
    if angle < 3.1:
        np.testing.assert_allclose(back, given, atol=2e-5)
    assert np.linalg.norm(back[:, :3], axis=1).max() <= np.pi + 1e-5


@pytest.mark.parametrize("angle", [1e-5, 1e-3, 0.009, 0.011, 0.5])
def test_exp_and_log_meet_their_series_in_double_precision(x64, angle):
    given = twists(angle, 5)

    found = exp(jnp.asarray(given))
    back = log(jnp.asarray(exponentials(given)))

    # each series stops where its next term would add less than this
    np.testing.assert_allclose(found, exponentials(given), rtol=0, atol=1e-11)
    np.testing.assert_allclose(back, given, rtol=0, atol=4e-7 * angle)


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_and_log_have_finite_gradients(angle):
    given = jnp.asarray(twists(angle, 3), jnp.float32)

    there, back = exp_slope(given), log_slope(exp(given))

    assert np.isfinite(there).all() and np.isfinite(back).all()


def test_moving_composing_and_inverting_agree():
    rng = np.random.default_rng(11)
    first, second = (jnp.asarray(t, jnp.float32) for t in random_motions(rng, 2))
    points = jnp.asarray(rng.normal(size=(7, 3)), jnp.float32)

    moved = rigid.apply(second, rigid.apply(first, points))

    np.testing.assert_allclose(rigid.apply(rigid.compose(second, first), points), moved, atol=5e-6)
    back = rigid.apply(rigid.inverse(second), moved)
    np.testing.assert_allclose(back, rigid.apply(first, points), atol=5e-6)
    homogeneous = np.concatenate([points, np.ones((7, 1))], axis=1) @ np.asarray(first).T
    np.testing.assert_allclose(rigid.apply(first, points), homogeneous[:, :3], atol=5e-6)
    np.testing.assert_allclose(
        rigid.rotate(first, points), rigid.apply(first, points) - first[:3, 3], atol=1e-6
    )


def test_quaternions_convert_in_both_directions():
    rotations = Rotation.random(300, random_state=12)
    half_turns = Rotation.from_rotvec(np.pi * np.eye(3))
    for given in (rotations, half_turns):
        matrices = jnp.asarray(given.as_matrix(), jnp.float32)

        quaternions = jax.jit(jax.vmap(rigid.to_wxyz))(matrices)

        assert (quaternions[:, 0] >= 0).all()
        np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1, atol=1e-6)
        back = jax.jit(jax.vmap(rigid.from_wxyz))(quaternions)
        np.testing.assert_allclose(back, matrices, atol=2e-6)


@pytest.mark.parametrize("degrees", [0.0, 1e-3, 0.02, 1.0, 45.0, 179.0, 180.0])
def test_the_rotation_error_is_the_angle_down_to_thousandths(degrees):
    rng = np.random.default_rng(13)
    truth = random_motions(rng, 1)[0]
    axis = rng.normal(size=3)
    turn = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    found = truth.copy()
    found[:3, :3] = turn @ truth[:3, :3]

    error = rigid.rotation_error(jnp.asarray(found, jnp.float32), jnp.asarray(truth, jnp.float32))

    np.testing.assert_allclose(error, degrees, rtol=1e-4, atol=0.03 if degrees == 180 else 2e-5)


def test_errors_have_finite_gradients_at_zero_error():
    truth = jnp.asarray(random_motions(np.random.default_rng(14), 1)[0], jnp.float32)

    for error in (rigid.rotation_error, rigid.translation_error):
        assert error(truth, truth) == 0
        assert np.isfinite(jax.grad(error)(truth, truth)).all(), error.__name__


def test_the_translation_error_is_that_of_the_remaining_motion():
    found, truth = random_motions(np.random.default_rng(15), 2)

    error = rigid.translation_error(*(jnp.asarray(t, jnp.float32) for t in (found, truth)))

    left = np.linalg.inv(truth) @ found
    np.testing.assert_allclose(error, np.linalg.norm(left[:3, 3]), rtol=1e-5)
