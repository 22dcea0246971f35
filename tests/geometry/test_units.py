"""From the caller's frame to the unit sphere and back, and the choice of points."""

import numpy as np
import pytest
import solids
from scipy.spatial import cKDTree

from cfr_jax.geometry import thinning, units
from cfr_jax.geometry.thinning import subsample
from cfr_jax.geometry.trees import Tree
from cfr_jax.geometry.units import bucket, to_unit, unit_frames
from cfr_jax.io import PointCloud

FAR = np.array([5e6, -5e6, 5e6])


def unit(cloud, frames, center, *, budget=2000, seed=0):
    return to_unit(
        cloud, center, frames.scale, np.eye(4), budget=budget, neighbors=16, radius=0.3, seed=seed
    )


def widest_gap(points, rows):
    """The largest distance of any point from its nearest chosen point."""
    return cKDTree(points[rows]).query(points)[0].max()


def uneven_square(count, seed):
    """A cloud with nine tenths of its points in a hundredth of its area."""
    rng = np.random.default_rng(seed)
    size = np.where(rng.random(count) < 0.9, 0.2, 2.0)[:, None]
    return rng.uniform(-0.5, 0.5, (count, 3)) * size * [1, 1, 0]


def test_a_cloud_within_budget_is_kept_whole():
    points = solids.sphere(50, 0).points

    assert subsample(points, 50, 0).tolist() == list(range(50))


def test_thinning_is_within_budget_and_determined_by_the_seed():
    points = solids.lopsided(3000, 0).points

    first, again, other = (subsample(points, 400, seed) for seed in (0, 0, 1))

    assert len(np.unique(first)) == len(first) == 400
    assert first.tolist() == again.tolist() != other.tolist()
    assert (np.diff(first) > 0).all()


def test_thinning_spreads_evenly_where_drawing_at_random_does_not():
    points = uneven_square(20_000, 0)

    gap = widest_gap(points, subsample(points, 400, 0))

    at_random = np.random.default_rng(0).choice(len(points), 400, replace=False)
    assert gap < 0.6 * widest_gap(points, at_random)
    assert gap < 5 * (4 / 400) ** 0.5 / 2


@pytest.mark.parametrize("away", [1e3, 1e9, 1e14])
def test_a_far_stray_point_does_not_stretch_the_grid(away):
    points = uneven_square(20_000, 0)
    gap = widest_gap(points, subsample(points, 400, 0))
    points = np.concatenate([points, [[away, -away, away]]])

    rows = subsample(points, 400, 0)

    assert len(rows) == 400
    assert widest_gap(points[:-1], rows[rows < 20_000]) < 1.5 * gap


def test_thinning_looks_at_a_bounded_number_of_points(monkeypatch):
    seen = []
    search = thinning._first_of_each_voxel

    def counted(points, voxel):
        seen.append(len(points))
        return search(points, voxel)

    monkeypatch.setattr(thinning, "_first_of_each_voxel", counted)

    subsample(np.random.default_rng(0).normal(size=(100_000, 3)), 100, 0)

    assert max(seen) <= 3200 and len(seen) <= 12


@pytest.mark.parametrize("places", [1, 5])
def test_points_in_few_places_are_drawn_from_all_of_them(places):
    points = np.repeat(np.arange(places * 3.0).reshape(places, 3), 2000, axis=0)

    rows = subsample(points, 100, 0)

    assert len(np.unique(rows)) == 100
    assert len(np.unique(points[rows], axis=0)) == places


def test_thinning_a_flat_cloud_is_not_decided_by_rounding():
    points = solids.plane(5000, 0).points
    wobble = 1e-10 * np.random.default_rng(0).normal(size=points.shape)

    assert subsample(points, 300, 0).tolist() == subsample(points + wobble, 300, 0).tolist()


@pytest.mark.parametrize("count", [65, 127, 128, 129, 500, 717, 1024, 5000, 123_456])
def test_buckets_hold_the_cloud_and_waste_little(count):
    size = bucket(count)

    assert count <= size <= max(128, 1.34 * count + 32)
    assert size % 32 == 0 and bucket(size) == size


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e3])
@pytest.mark.parametrize("offset", [0.0, 1.0])
def test_a_motion_between_unit_clouds_comes_back_in_the_callers_frame(scale, offset):
    truth = solids.motion(50)
    truth[:3, 3] = scale * truth[:3, 3] + offset * scale * FAR[::-1]
    source = scale * (solids.lopsided(200, 0).points + offset * FAR)
    target = solids.move(truth, source)
    frames = unit_frames(PointCloud(source), PointCloud(target), None)
    # the same motion between the unit clouds, as the device would find it
    between = truth.copy()
    about = truth[:3, :3] @ frames.source_center + truth[:3, 3]
    between[:3, 3] = (about - frames.target_center) / frames.scale

    found = frames.to_caller(between.astype(np.float32)[None])[0]

    assert np.abs(solids.move(found, source) - target).max() < 2e-6 * scale
    assert np.abs(found[:3, :3] @ found[:3, :3].T - np.eye(3)).max() < 1e-12
    assert np.linalg.det(found[:3, :3]) > 0


@pytest.mark.parametrize("offset", [0.0, 1.0])
def test_unit_clouds_are_centered_and_as_large_as_the_unit_sphere(offset):
    points = 7 * solids.lopsided(800, 0).points + offset * FAR
    cloud = PointCloud(points)
    frames = unit_frames(cloud, PointCloud(points[:500]), None)

    found = unit(cloud, frames, frames.source_center)

    length = np.linalg.norm(found.points[found.mask], axis=1)
    assert 0.99 < np.quantile(length, 0.995) < 1.01
    assert np.abs(found.points[found.mask].mean(axis=0)).max() < 0.01
    assert found.mask.sum() == 800 == len(found.rows)


def test_padding_is_zero_and_never_a_neighbor():
    cloud = PointCloud(*solids.lopsided(130, 0))
    frames = unit_frames(cloud, cloud, None)

    found = unit(cloud, frames, frames.source_center)

    assert len(found.points) == 160 and found.mask.tolist() == [True] * 130 + [False] * 30
    assert found.neighbors.max() < 130
    assert not found.points[130:].any() and not found.normals[130:].any()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("offset", [0.0, 1.0])
def test_an_initial_motion_is_kept_where_the_network_changes_nothing(dtype, offset):
    source = PointCloud(solids.lopsided(200, 0).points + offset * FAR)
    initial = solids.motion(120, translation=(0, 0, 0))
    initial[:3, 3] = -initial[:3, :3] @ source.points.mean(axis=0)
    initial = initial.astype(dtype).astype(np.float64)
    target = PointCloud(solids.move(initial, source.points))

    frames = unit_frames(source, target, initial)
    found = frames.to_caller(np.eye(4))

    # a rounded rotation is not exact; its error turns the cloud about itself, not about the origin
    assert np.abs(found[:3, :3] @ found[:3, :3].T - np.eye(3)).max() < 1e-12
    assert np.abs(solids.move(found, source.points) - target.points).max() < 1e-6
    assert np.array_equal(frames.source_center, frames.target_center)


def test_an_initial_motion_turns_points_and_normals():
    cloud = PointCloud(*solids.lopsided(100, 0))
    initial = solids.motion(70)

    found = to_unit(cloud, np.zeros(3), 1.0, initial, budget=100, neighbors=16, radius=0.3, seed=0)

    assert np.abs(found.points[:100] - solids.move(initial, cloud.points)).max() < 1e-6
    assert np.abs(found.normals[:100] - cloud.normals @ initial[:3, :3].T).max() < 1e-6


@pytest.mark.parametrize("away", [30.0, 1e6])
def test_stray_points_neither_move_the_frame_nor_reach_the_network(away):
    points = solids.lopsided(500, 0).points
    clean, stray = PointCloud(points), PointCloud(np.concatenate([[[away, 0, 0]], points]))

    frames, wanted = unit_frames(stray, clean, None), unit_frames(clean, clean, None)
    found = unit(stray, frames, frames.source_center)

    assert np.abs(frames.source_center - wanted.source_center).max() < 0.01
    assert abs(frames.scale / wanted.scale - 1) < 0.02
    assert found.rows.tolist() == list(range(1, 501))


@pytest.mark.parametrize("at", [0.0, 1.0, 5e6])
def test_a_cloud_without_extent_is_refused_by_name(at):
    cloud, spot = PointCloud(solids.sphere(50, 0).points), PointCloud(np.full((50, 3), at))

    with pytest.raises(ValueError, match="^target: all of its 50 points lie in one place"):
        unit_frames(cloud, spot, None)


@pytest.mark.parametrize("share", [0.006, 0.02, 0.045])
def test_points_far_out_do_not_decide_the_size(share):
    points = solids.lopsided(1000, 0).points
    count = int(share * len(points))
    rng = np.random.default_rng(0)
    spoiled = points.copy()
    spoiled[:count] = rng.uniform(200, 1000, (count, 1)) * solids.sphere(count, 0).points

    clean, found = (unit_frames(PointCloud(p), PointCloud(p), None) for p in (points, spoiled))

    assert found.scale == pytest.approx(clean.scale, rel=0.03)
    np.testing.assert_allclose(found.source_center, clean.source_center, atol=0.03)
    assert found.strays == (count, count) and clean.strays == (0, 0)


def test_a_scan_that_thins_out_toward_its_edge_is_kept_whole():
    rng = np.random.default_rng(0)
    away = 2 * np.exp(rng.random(5000) * np.log(40))  # 2 to 80 m: forty to one
    points = away[:, None] * solids.sphere(5000, 0).points * [1, 1, 0.02]

    assert units._gathered(points).all()


def test_each_place_counts_once_where_points_come_again_and_again():
    points = solids.lopsided(300, 0).points
    cloud = PointCloud(np.repeat(points, 20, axis=0))
    frames = unit_frames(cloud, cloud, None)

    found = unit(cloud, frames, frames.source_center)

    assert found.rows.tolist() == list(range(0, 6000, 20))
    assert Tree(cloud.points).spacing == pytest.approx(Tree(points).spacing)


def test_the_first_row_of_each_place_is_numpys():
    points = np.random.default_rng(0).integers(0, 3, (200, 3)).astype(float)

    wanted = np.sort(np.unique(points, axis=0, return_index=True)[1])
    assert thinning.first_of_each_place(points).tolist() == wanted.tolist()
