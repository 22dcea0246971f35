import numpy as np
import pytest
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from cfr_jax.evaluation import metrics
from cfr_jax.evaluation.measuring import bootstrap


def motions(rotations, translations):
    out = np.tile(np.eye(4), (len(translations), 1, 1))
    out[:, :3, :3] = rotations.as_matrix()
    out[:, :3, 3] = translations
    return out


def known_errors(count=50, seed=0):
    """Truths, and estimates that are off by known angles and distances."""
    rng = np.random.default_rng(seed)
    angles, distances = rng.uniform(0.1, 180, count), rng.uniform(0, 3, count)
    unit = [rng.normal(size=(count, 3)) for _ in range(2)]
    axes, ways = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in unit)
    turned = Rotation.random(count, random_state=seed)
    truths = motions(turned, rng.normal(size=(count, 3)))
    off = motions(
        Rotation.from_rotvec(axes * np.radians(angles)[:, None]), ways * distances[:, None]
    )
    return truths @ off, truths, angles, distances


def test_a_known_rotation_and_translation_error_are_recovered():
    estimates, truths, angles, distances = known_errors()

    np.testing.assert_allclose(metrics.err_r(estimates, truths), angles, rtol=1e-6)
    np.testing.assert_allclose(metrics.err_t(estimates, truths), distances, rtol=1e-12)


def test_errors_do_not_depend_on_the_frame_of_the_source_nor_the_target():
    estimates, truths, angles, distances = known_errors()
    moved = motions(Rotation.random(1, random_state=9), [[1.0, -2.0, 3.0]])

    np.testing.assert_allclose(metrics.err_r(moved @ estimates, moved @ truths), angles, rtol=1e-6)
    np.testing.assert_allclose(metrics.err_t(moved @ estimates, moved @ truths), distances)
    np.testing.assert_allclose(metrics.err_r(estimates @ moved, truths @ moved), angles, rtol=1e-6)


def test_equal_motions_answer_within_the_documented_floor():
    _, truths, _, _ = known_errors(2000)

    assert metrics.err_r(truths, truths).max() <= 5e-6
    assert metrics.err_r(truths.astype(np.float32), truths).max() <= 0.03
    assert metrics.err_t(truths, truths).max() == 0


def test_euler_errors_are_those_written_into_the_angles():
    rng = np.random.default_rng(1)
    angles = rng.uniform(-80, 80, (20, 3))
    off = rng.uniform(-5, 5, (20, 3))
    # About fixed axes, x first: R = Rz Ry Rx.
    turns = [
        Rotation.from_rotvec(np.radians(a[:, 2:]) * [[0, 0, 1]])
        * Rotation.from_rotvec(np.radians(a[:, 1:2]) * [[0, 1, 0]])
        * Rotation.from_rotvec(np.radians(a[:, :1]) * [[1, 0, 0]])
        for a in (angles + off, angles)
    ]
    estimates, truths = motions(turns[0], off / 10), motions(turns[1], np.zeros((20, 3)))

    np.testing.assert_allclose(metrics.r_mae(estimates, truths), np.abs(off).mean(1))
    np.testing.assert_allclose(metrics.r_rmse(estimates, truths), np.sqrt((off**2).mean(1)))
    np.testing.assert_allclose(metrics.t_mae(estimates, truths), np.abs(off / 10).mean(1))
    np.testing.assert_allclose(metrics.t_rmse(estimates, truths), np.sqrt((off**2 / 100).mean(1)))


def test_gimbal_lock_is_answered_without_a_warning():
    locked = motions(Rotation.from_euler("xyz", [[10, 90, 20]], degrees=True), [[0, 0, 0]])

    assert np.isfinite(metrics.r_mae(locked, locked)).all()


def test_chamfer_agrees_with_the_full_matrix_of_distances():
    rng = np.random.default_rng(2)
    source, target = rng.normal(size=(40, 3)), rng.normal(size=(30, 3))
    clean_source, clean_target = rng.normal(size=(70, 3)), rng.normal(size=(60, 3))
    (estimate,) = motions(Rotation.random(1, random_state=3), rng.normal(size=(1, 3)))

    found = metrics.chamfer(estimate, source, target, clean_source, clean_target)

    def moved(points):
        return np.array([estimate @ [*point, 1] for point in points])[:, :3]

    forward = cdist(moved(source), clean_target, "sqeuclidean").min(1).mean()
    backward = cdist(target, moved(clean_source), "sqeuclidean").min(1).mean()
    assert found == pytest.approx(forward + backward, rel=1e-12)


def test_chamfer_of_the_truth_is_zero_however_much_was_cropped():
    rng = np.random.default_rng(4)
    clean_source = rng.normal(size=(100, 3))
    (truth,) = motions(Rotation.random(1, random_state=3), rng.normal(size=(1, 3)))
    clean_target = clean_source @ truth[:3, :3].T + truth[:3, 3]

    found = metrics.chamfer(truth, clean_source[:20], clean_target[60:], clean_source, clean_target)

    assert found < 1e-28


def test_recall_needs_both_errors_below_their_thresholds():
    angles, distances = np.array([0.5, 0.5, 2.0, 1.0]), np.array([0.05, 0.5, 0.05, 0.05])

    hits = metrics.recalled(angles, distances, 1.0, 0.1)

    np.testing.assert_array_equal(hits, [True, False, False, False])


def test_intervals_hold_the_true_mean_about_as_often_as_they_say():
    held = 0
    for trial in range(200):
        values = np.random.default_rng(trial).normal(3.0, 1.0, 60)
        _, low, high = bootstrap(values, resamples=300, seed=trial)
        held += low <= 3.0 <= high

    assert 0.89 <= held / 200 <= 0.99


def test_the_same_seed_gives_the_same_interval():
    values = np.random.default_rng(0).exponential(size=40)

    assert bootstrap(values, seed=1) == bootstrap(values, seed=1)
    assert bootstrap(values, seed=1) != bootstrap(values, seed=2)


def test_the_root_mean_square_is_over_all_axes_of_all_pairs():
    estimates, truths, *_ = known_errors()

    each = metrics.t_rmse(estimates, truths)
    whole = bootstrap(each, metrics.root_mean_square)

    squares = (estimates - truths)[:, :3, 3] ** 2
    assert whole.value == pytest.approx(np.sqrt(squares.mean()))
    assert whole.low <= whole.value <= whole.high


def test_bad_input_is_named():
    good = np.eye(4)[None]

    with pytest.raises(ValueError, match="estimates holds numbers that are not finite"):
        metrics.err_r(good * np.nan, good)
    with pytest.raises(ValueError, match=r"\(1, 4, 4\) and truths \(2, 4, 4\)"):
        metrics.err_t(good, np.concatenate([good, good]))
    with pytest.raises(ValueError, match="at least one pair"):
        bootstrap(np.zeros(0))
