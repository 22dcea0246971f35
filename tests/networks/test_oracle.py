"""The pieces of the oracle: if these hold, a disagreement means that the library is wrong."""

import numpy as np
import pytest
from oracle import clouds, measures, pieces
from oracle.network import soft_target
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture(scope="module")
def pair():
    return clouds.random_pair(seed=3, n=90, m=80)


def random_transform(rng):
    return pieces.rigid(Rotation.random(None, rng).as_matrix(), rng.normal(size=3))


def random_units(rng, *shape):
    vectors = rng.normal(size=(*shape, 3))
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


# Rigid motion


def test_procrustes_recovers_the_motion_of_one_to_one_correspondences(rng):
    x, truth = rng.normal(size=(40, 3)), random_transform(rng)
    order = rng.permutation(40)
    y = pieces.move(truth, x)[order]
    one_hot = (np.arange(40)[:, None] == order).astype(float)

    matched, weights = soft_target(one_hot, y)

    np.testing.assert_array_equal(weights, 1)
    # soft_target divides by 1 + 1e-5, and nothing else stands between the answer and the truth
    fitted = pieces.procrustes(x, matched * (1 + 1e-5), weights, epsilon=0)
    np.testing.assert_allclose(fitted, truth, atol=1e-12)


def test_procrustes_agrees_with_scipy_on_noisy_weighted_rows(rng):
    x, y, w = rng.normal(size=(40, 3)), rng.normal(size=(40, 3)), rng.uniform(size=40)
    x_center, y_center = (np.average(points, axis=0, weights=w) for points in (x, y))

    fitted = pieces.procrustes(x, y, w, epsilon=0)

    expected = Rotation.align_vectors(y - y_center, x - x_center, weights=w)[0].as_matrix()
    np.testing.assert_allclose(fitted[:3, :3], expected, atol=1e-10)
    np.testing.assert_allclose(pieces.move(fitted, x_center), y_center, atol=1e-12)


def test_procrustes_never_answers_with_a_reflection(rng):
    x = rng.normal(size=(40, 3))

    rotation = pieces.procrustes(x, x * [1, 1, -1], np.ones(40))[:3, :3]

    assert np.linalg.det(rotation) == pytest.approx(1)


# Sinkhorn


@pytest.mark.parametrize("passes", [1, 2, 5])
def test_the_three_forms_of_sinkhorn_agree(rng, passes):
    log_affinity = rng.normal(scale=3, size=(12, 17))

    log_form = pieces.sinkhorn_log(log_affinity, passes)

    matrix_form = pieces.sinkhorn_matrix(np.exp(log_affinity), passes)
    scaling_form = pieces.sinkhorn_scaling(np.exp(log_affinity), passes)
    np.testing.assert_allclose(log_form, matrix_form, rtol=1e-12)
    np.testing.assert_allclose(log_form, scaling_form, rtol=1e-12)


def test_one_pass_on_a_single_pair_is_the_fraction_worked_out_by_hand():
    # row: m / (m + 1); then column: that / (that + 1) = m / (2m + 1)
    np.testing.assert_allclose(pieces.sinkhorn_log(np.log([[3.0]]), 1), 3 / 7)


def test_sinkhorn_stays_a_partial_match_at_affinities_that_overflow(rng):
    match = pieces.sinkhorn_log(rng.uniform(-1e4, 1e4, size=(6, 5)), 5)

    assert np.isfinite(match).all()
    assert match.sum(axis=0).max() <= 1 + 1e-12  # columns are divided last
    assert match.max() > 0.1


# Layers and features


def test_group_norm_equals_its_channels_first_definition_group_by_group(rng):
    rows = rng.normal(loc=2, scale=3, size=(5, 7, 16))
    weight, bias = rng.normal(size=16), rng.normal(size=16)
    expected = np.empty_like(rows)
    for group in np.split(np.arange(16), 4):
        values = [rows[i, k, c] for i in range(5) for k in range(7) for c in group]
        mean = sum(values) / len(values)
        variance = sum((value - mean) ** 2 for value in values) / len(values)
        for c in group:
            expected[..., c] = (
                weight[c] * (rows[..., c] - mean) / (variance + 1e-5) ** 0.5 + bias[c]
            )

    np.testing.assert_allclose(pieces.group_norm(rows, weight, bias, groups=4), expected)


def test_nearest_neighbors_are_those_of_a_kd_tree(rng):
    points = rng.normal(size=(50, 3))

    found = pieces.nearest_neighbors(points, 8)

    np.testing.assert_array_equal(found, cKDTree(points).query(points, 9)[1][:, 1:])


def test_a_duplicate_is_a_neighbor_and_the_point_itself_is_not(rng):
    points = np.repeat(rng.normal(size=(10, 3)), 2, axis=0)

    nearest = pieces.nearest_neighbors(points, 5)[:, 0]

    np.testing.assert_array_equal(nearest, np.arange(20) ^ 1)  # the twin


def test_neighbors_beyond_the_radius_become_the_nearest_which_always_stays():
    points = np.array([[0.0, 0, 0], [0.2, 0, 0], [0.7, 0, 0], [2.0, 0, 0]])

    limited = pieces.limit_to_radius(points, pieces.nearest_neighbors(points, 3), radius=0.5)

    assert limited.tolist() == [[1, 1, 1], [0, 2, 0], [1, 1, 1], [2, 2, 2]]


def test_ball_query_takes_members_by_index_and_fills_up_with_the_center():
    points = np.array([[0.3, 0, 0], [0.2, 0, 0], [0.1, 0, 0], [0.0, 0, 0], [9, 0, 0]])

    assert pieces.ball_query(points, 1.0, 2)[3].tolist() == [0, 1]
    assert pieces.ball_query(points, 1.0, 6)[1].tolist() == [0, 1, 2, 3, 1, 1]
    assert pieces.ball_query(points, 1.0, 6, drop_self=True)[1].tolist() == [0, 2, 3, 1, 1, 1]
    assert pieces.ball_query(points, 1.0, 3)[4].tolist() == [4, 4, 4]


@pytest.mark.parametrize("ppf", [pieces.inner_product_ppf, pieces.angle_ppf])
def test_point_pair_features_do_not_turn_with_the_cloud(pair, rng, ppf):
    neighbors = pieces.nearest_neighbors(pair.x, 6)
    offsets = pair.x[neighbors] - pair.x[:, None]
    rotation = Rotation.random(None, rng).as_matrix().T

    turned = ppf(pair.nx @ rotation, offsets @ rotation, pair.nx[neighbors] @ rotation)

    np.testing.assert_allclose(turned, ppf(pair.nx, offsets, pair.nx[neighbors]), atol=1e-6)


def test_point_pair_features_come_in_the_published_order():
    z, x = np.array([[0.0, 0, 1]]), np.array([[[1.0, 0, 0]]])
    quarter = np.pi / 2

    # own normal against the offset, the neighbor's against it, the normals, the distance
    inner = pieces.inner_product_ppf(z, 2 * x, x)
    np.testing.assert_allclose(inner, [[[0, 1, 0, 2]]], atol=1e-6)
    angle = pieces.angle_ppf(z, 2 * x, x)
    np.testing.assert_allclose(angle, [[[quarter, 0, quarter, 2]]])


def test_both_point_pair_features_tell_the_same_angles(rng):
    normals = random_units(rng, 9)
    neighbor_normals, offsets = random_units(rng, 9, 4), 0.5 * random_units(rng, 9, 4)

    cosines = pieces.inner_product_ppf(normals, offsets, neighbor_normals)
    angles = pieces.angle_ppf(normals, offsets, neighbor_normals)

    np.testing.assert_allclose(np.cos(angles[..., :3]), cosines[..., :3], atol=1e-5)
    np.testing.assert_allclose(angles[..., 3], 0.5)


def test_a_zero_offset_has_finite_features():
    normal, zero = np.array([[0.0, 0, 1]]), np.zeros((1, 1, 3))

    assert pieces.inner_product_ppf(normal, zero, normal[:, None]).tolist() == [[[0, 0, 1, 0]]]
    assert pieces.angle_ppf(normal, zero, normal[:, None]).tolist() == [[[0, 0, 0, 0]]]


def test_normals_of_the_synthetic_clouds_are_those_of_their_surface():
    dense = clouds.random_pair(seed=4, n=4000, m=65)

    estimated = pieces.pca_normals(dense.x, pieces.nearest_neighbors(dense.x, 12))

    assert np.quantile(np.abs((estimated * dense.nx).sum(axis=1)), 0.05) > 0.99


# Measures


def test_rotation_error_is_the_angle_put_in_and_translation_error_the_distance(rng):
    truth = random_transform(rng)
    turn = pieces.rigid(Rotation.from_rotvec([0, 0, np.radians(10)]).as_matrix(), np.zeros(3))
    shift = pieces.rigid(np.eye(3), np.array([0.0, 3, 4]))

    assert measures.err_r((truth @ turn)[None], truth[None]) == pytest.approx([10])
    assert measures.err_t((truth @ turn)[None], truth[None]) == pytest.approx([0], abs=1e-12)
    assert measures.err_t((shift @ truth)[None], truth[None]) == pytest.approx([5])


def test_axis_errors_are_means_over_pairs_and_axes():
    turn = Rotation.from_euler("xyz", [10, 20, 33], degrees=True).as_matrix()
    truth = Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix()
    predicted = pieces.rigid(turn, np.array([0.0, 0, 6]))

    errors = measures.axis_errors(predicted[None], pieces.rigid(truth, np.zeros(3))[None])

    expected = {"r_mae": 1, "r_rmse": 3**0.5, "t_mae": 2, "t_rmse": 12**0.5}
    assert errors == pytest.approx(expected)


def test_chamfer_carries_the_reference_by_the_error_of_the_prediction(rng):
    clean, truth = np.stack(np.mgrid[:3, :3, :3], -1).reshape(-1, 3) * 1.0, random_transform(rng)
    source = pieces.move(np.linalg.inv(truth), clean)
    shift = pieces.rigid(np.eye(3), np.array([0.1, 0, 0]))
    shifted = pieces.move(shift, clean)

    assert measures.chamfer(source, clean, clean, truth, truth) == pytest.approx(0, abs=1e-20)
    assert measures.chamfer(source, clean, clean, shift @ truth, truth) == pytest.approx(0.02)
    assert measures.chamfer(source, shifted, clean, shift @ truth, truth) == pytest.approx(0.01)
