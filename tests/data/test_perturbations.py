import numpy as np
import pytest

from cfr_jax.data import perturbations


def test_noise_is_clipped_and_has_the_stated_scale():
    points = np.zeros((20000, 3), np.float32)

    moved = perturbations.jitter(points, np.random.default_rng(0))

    assert moved.dtype == np.float32
    assert np.abs(moved).max() <= 0.05
    assert moved.std() == pytest.approx(0.01, rel=0.02)


def test_euler_angles_and_translations_fill_their_ranges():
    rng = np.random.default_rng(0)

    motions = np.array(
        [perturbations.random_motion(45.0, 0.5, rng) for _ in range(2000)], np.float64
    )

    y = np.degrees(np.arcsin(motions[:, 0, 2]))
    assert 0 <= y.min() < 0.5 and 44.5 < y.max() <= 45
    assert motions[:, :3, 3].min() < -0.49 and motions[:, :3, 3].max() > 0.49
    np.testing.assert_allclose(np.linalg.det(motions), 1, atol=1e-6)


@pytest.mark.parametrize("legacy", [True, False])
def test_any_rotation_is_drawn_uniformly(legacy):
    rng = np.random.RandomState(0) if legacy else np.random.default_rng(0)

    motions = np.array(
        [perturbations.random_motion(None, 0.5, rng) for _ in range(4000)], np.float64
    )

    # for uniform rotations, entries have mean 0 and variance 1/3, angles the mean pi / 2 + 2 / pi
    rotations = motions[:, :3, :3]
    np.testing.assert_allclose(rotations.mean(axis=0), 0, atol=0.04)
    np.testing.assert_allclose(rotations.var(axis=0), 1 / 3, atol=0.02)
    angle = np.arccos(np.clip((np.trace(rotations, axis1=1, axis2=2) - 1) / 2, -1, 1))
    assert angle.mean() == pytest.approx(np.pi / 2 + 2 / np.pi, abs=0.03)


def test_too_few_points_are_all_used_before_any_is_repeated():
    rows = perturbations.resample(5, 8, np.random.default_rng(0))

    assert len(rows) == 8
    assert set(rows[:5]) == set(range(5))


def test_a_crop_that_leaves_nothing_is_refused():
    with pytest.raises(ValueError, match="leaves none of 8 points"):
        perturbations.crop(np.zeros((8, 3), np.float32), 0.7, np.random.default_rng(0))


@pytest.mark.parametrize("overlap", [0.1, 0.5, 0.9])
def test_two_ends_of_a_shape_share_what_they_should_and_are_the_whole(overlap):
    points = np.random.default_rng(3).normal(size=(1000, 3)) + [5.0, 0.0, 0.0]

    first, second = perturbations.opposite_sides(points, overlap, np.random.default_rng(0))

    both = np.intersect1d(first, second)
    assert len(first) == len(second)
    assert len(both) / len(first) == pytest.approx(overlap, abs=0.003)
    assert len(np.union1d(first, second)) == len(points)
    # cut across one direction: it tells the three parts apart
    only_first, only_second = np.setdiff1d(first, both), np.setdiff1d(second, both)
    along = points[only_second].mean(axis=0) - points[only_first].mean(axis=0)
    assert (points[only_first] @ along).mean() < (points[both] @ along).mean()
    assert (points[both] @ along).mean() < (points[only_second] @ along).mean()
