"""Augmentations: each one does what its field says, in the stated amount, and nothing else."""

import numpy as np
import pytest
from oracle import pieces
from scipy.spatial.transform import Rotation

from cfr_jax.data.augmentation import pairs_on_host
from cfr_jax.data.augmentation.pairs_on_host import View, choose_rows, finish_pair
from cfr_jax.data.augmentation.sampling import Sampling

STILL = {"keep": (1.0, 1.0), "noise": (0.0, 0.0), "angle": 0.0, "translation": 0.0}


@pytest.fixture(scope="module")
def sphere():
    """400 points on the unit sphere, which are also the normals."""
    points = np.random.default_rng(0).normal(size=(400, 3))
    return (points / np.linalg.norm(points, axis=1, keepdims=True)).astype(np.float32)


def still(**changes):
    return Sampling(points=400, neighbors=6, **STILL | changes)


def drawn(sphere, sampling, seed=0, truth=None):
    view = View(sphere, sphere)
    truth = np.eye(4) if truth is None else truth
    return finish_pair(view, view, truth, sampling, np.random.default_rng(seed))


def test_without_augmentations_nothing_changes(sphere):
    pair = drawn(sphere, still())

    np.testing.assert_array_equal(pair["transform"], np.eye(4))
    for side in ("source", "target"):
        np.testing.assert_allclose(pair[side], sphere, atol=1e-6)
        np.testing.assert_allclose(pair[f"{side}_normals"], sphere, atol=1e-6)
    assert not pair["estimate_normals"]


@pytest.mark.parametrize(("seed", "centered"), [(0, 0.0), (1, 0.0), (2, 1.0), (3, 1.0)])
def test_with_all_augmentations_the_truth_is_still_right(sphere, seed, centered):
    truth = np.eye(4)
    truth[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    truth[:3, 3] = 0.3, -0.2, 0.1
    source = View((sphere - truth[:3, 3].astype(np.float32)) @ truth[:3, :3].astype(np.float32),
                  sphere @ truth[:3, :3].astype(np.float32))  # fmt: skip
    sampling = still(
        any_orientation=1.0, scale=(0.5, 2.0), angle=45.0, translation=0.5, centered=centered
    )

    pair = finish_pair(source, View(sphere, sphere), truth, sampling, np.random.default_rng(seed))

    moved = pieces.move(pair["transform"].astype(np.float64), pair["source"])
    np.testing.assert_allclose(moved, pair["target"], atol=1e-5)
    turned = pair["source_normals"] @ pair["transform"][:3, :3].T
    np.testing.assert_allclose(turned, pair["target_normals"], atol=1e-5)
    rotation = pair["transform"][:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)


def test_orientation_turns_as_many_shapes_as_asked(sphere):
    targets = [drawn(sphere, still(any_orientation=0.3), seed)["target"] for seed in range(200)]

    turned = sum(np.abs(target - sphere).max() > 1e-3 for target in targets)
    assert 40 <= turned <= 80
    np.testing.assert_allclose(np.linalg.norm(targets, axis=-1), 1, atol=1e-5)


def euler_angles(sphere, **changes):
    """Euler angles, in degrees, of the motions of 300 pairs. The truth undoes the motion."""
    made = [drawn(sphere, still(angle=45.0, **changes), seed)["transform"] for seed in range(300)]
    undone = [Rotation.from_matrix(transform[:3, :3].T) for transform in made]
    return np.array([rotation.as_euler("XYZ", degrees=True) for rotation in undone])


def test_both_ways_turns_as_many_pairs_as_asked_about_each_axis_either_way(sphere):
    one_way, mixed, any_way = (euler_angles(sphere, both_ways=share) for share in (0.0, 0.4, 1.0))

    assert one_way.min() > -1e-3 and np.abs(any_way).max() < 45.001
    for angles, negative in ((mixed, 0.2), (any_way, 0.5)):
        np.testing.assert_allclose((angles < 0).mean(axis=0), negative, atol=0.08)
    assert any_way.min() < -40 and any_way.max() > 40


def test_centered_clouds_lie_about_their_centroids_as_often_as_asked(sphere):
    half, sampling = sphere[sphere[:, 2] > 0], still(translation=0.5, centered=0.4)

    pairs = [drawn(half, sampling, seed) for seed in range(200)]

    apart = np.array([[np.linalg.norm(pair[side].mean(axis=0)) for side in ("source", "target")]
                      for pair in pairs])  # fmt: skip
    assert 60 <= (apart < 1e-6).all(axis=1).sum() <= 100
    assert ((apart < 1e-6).all(axis=1) | (apart > 1e-6).all(axis=1)).all()


def test_near_shrinks_as_many_motions_as_asked(sphere):
    far, mixed, near = (euler_angles(sphere, near=share) for share in (0.0, 0.5, 1.0))

    # the mean of an angle is 22.5, and half of that if it is scaled by a factor from [0, 1]
    for angles, wanted in ((far, 22.5), (mixed, 16.9), (near, 11.25)):
        assert abs(angles.mean() - wanted) < 2
    shift = [drawn(sphere, still(translation=0.5, near=1.0), seed) for seed in range(300)]
    away = np.abs([pair["transform"][:3, 3] for pair in shift])
    assert abs(away.mean() - 0.125) < 0.02


def test_scale_stretches_both_clouds_by_one_factor_within_its_range(sphere):
    factors = []
    for seed in range(50):
        pair = drawn(sphere, still(scale=(0.5, 2.0)), seed)
        lengths = [np.linalg.norm(pair[side], axis=1) for side in ("source", "target")]
        np.testing.assert_allclose(lengths, lengths[0][0], rtol=1e-5)
        factors.append(lengths[0][0])

    assert 0.5 <= min(factors) < 0.7 and 1.7 < max(factors) <= 2.0


def test_noise_has_the_strength_asked_for_on_every_axis(sphere):
    offset = drawn(sphere, still(noise=(0.02, 0.02)))["target"] - sphere

    np.testing.assert_allclose(offset.std(axis=0), 0.02, rtol=0.15)
    assert np.abs(offset).max() <= 0.1 + 1e-6


def test_sensor_noise_lies_along_the_rays_and_grows_with_distance_squared(sphere, monkeypatch):
    monkeypatch.setattr(pairs_on_host, "_direction", lambda rng: np.array([0.0, 0.0, 1.0]))
    monkeypatch.setattr(pairs_on_host, "SENSOR_AWAY", (2.0, 2.0))
    points = np.repeat(sphere.astype(np.float64), 20, axis=0)
    sampling = still(sensor_scale=(0.01, 0.01))

    moved = pairs_on_host.add_sensor_noise(points, sampling, np.random.default_rng(0))

    ray = points - (points.mean(axis=0) + [0, 0, 2])
    distance = np.linalg.norm(ray, axis=1, keepdims=True)
    along = np.sum((moved - points) * ray / distance, axis=1)
    np.testing.assert_allclose(moved - points, along[:, None] * ray / distance, atol=1e-12)
    near, far = distance[:, 0] < 1.3, distance[:, 0] > 2.7
    for part in (near, far):
        wanted = 0.01 * np.sqrt(np.mean((distance[part] / 2) ** 4))
        np.testing.assert_allclose(along[part].std(), wanted, rtol=0.1)


def test_sensor_noise_replaces_the_other_noise_in_its_share_of_pairs(sphere):
    sampling = still(sensor_noise=0.5, sensor_scale=(0.01, 0.01))

    moved = [
        np.abs(drawn(sphere, sampling, seed)["target"] - sphere).max() > 1e-5 for seed in range(100)
    ]

    assert 35 <= sum(moved) <= 65


def test_outliers_are_as_many_as_asked_and_fill_the_ball(sphere):
    pair = drawn(sphere, still(outliers=(0.25, 0.25)))

    for side in ("source", "target"):
        length = np.linalg.norm(pair[side], axis=1)
        out = np.abs(length - 1) > 1e-4
        assert 90 <= out.sum() <= 100  # of 400; one may fall on the sphere
        np.testing.assert_allclose(np.linalg.norm(pair[f"{side}_normals"], axis=1), 1, atol=1e-5)
        # in a unit ball, an eighth of the points lies within half the radius
        assert 0.04 < (length[out] < 0.55).mean() < 0.35
        assert length.max() < 1.2


def test_uneven_clouds_are_denser_on_one_side_by_the_factor_asked_for():
    points = np.random.default_rng(1).uniform(-1, 1, size=(40_000, 3))
    sampling = Sampling(points=4000, neighbors=6, density=(8.0, 8.0))
    rng = np.random.default_rng(2)

    rows = choose_rows(points, sampling, True, rng)

    assert len(np.unique(rows)) == 4000
    # the direction is unknown, but by symmetry it is the direction of the mean
    axis = points[rows].mean(axis=0)
    axis /= np.linalg.norm(axis)
    height = points @ axis
    low, high = np.quantile(height, [0.02, 0.98])
    share = np.zeros(len(points), bool)
    share[rows] = True
    sparse, dense = share[height < low].mean(), share[height > high].mean()
    assert 3 < dense / sparse < 12
    even = choose_rows(points, sampling, False, rng)
    assert np.linalg.norm(points[even].mean(axis=0)) < 0.05


def test_if_points_are_too_few_all_are_used_before_any_repeats():
    points = np.random.default_rng(0).normal(size=(10, 3))
    sampling = Sampling(points=24, neighbors=6)

    for uneven in (False, True):
        rows = choose_rows(points, sampling, uneven, np.random.default_rng(0))
        assert len(rows) == 24 and set(rows.tolist()) == set(range(10))


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_normals_are_estimated_in_the_share_of_pairs_asked_for(sphere, share):
    estimated = [
        drawn(sphere, still(estimated_normals=share), seed)["estimate_normals"]
        for seed in range(100)
    ]

    assert abs(np.mean(estimated) - share) < 0.12


def test_clouds_without_normals_have_them_estimated(sphere):
    view = View(sphere, None)

    pair = finish_pair(view, view, np.eye(4), still(), np.random.default_rng(0))

    assert pair["estimate_normals"] and not pair["source_normals"].any()


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        ({"uneven": 1.5}, "uneven: got 1.5"),
        ({"noise": (0.2, 0.1)}, "noise"),
        ({"keep": (0.0, 0.5)}, "keep"),
        ({"density": (0.5, 2.0)}, "density"),
        ({"outliers": (0.0, 1.0)}, "outliers"),
        ({"neighbors": 400}, "neighbors: got 400"),
    ],
)
def test_impossible_settings_are_refused_by_name(change, wanted):
    with pytest.raises(ValueError, match=wanted):
        Sampling(**{"points": 400, "neighbors": 6} | change)
