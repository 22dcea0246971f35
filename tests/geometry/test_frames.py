"""What ties unit clouds to the caller's coordinates, by what it must satisfy."""

import numpy as np
import pytest
import solids
from scipy.spatial import cKDTree

from cfr_jax.geometry import thinning, units
from cfr_jax.io import PointCloud

FAR = np.array([300.0, -200.0, 100.0])


def shifted(cloud, by):
    points = cloud.points + by
    return PointCloud(points), points


@pytest.mark.parametrize("given", [False, True])
def test_motions_go_to_the_unit_clouds_and_back(given):
    source, points = shifted(solids.lopsided(200, 0), FAR)
    initial = solids.motion(20, translation=(0.1, 0, 0))
    initial[:3, 3] += points.mean(axis=0) - initial[:3, :3] @ points.mean(axis=0)
    target = PointCloud(solids.move(initial, points))
    frames = units.unit_frames(source, target, initial if given else None)
    several = np.stack([solids.motion(angle, translation=(3, 2, 1)) for angle in (0, 50, 170)])

    found = frames.to_caller(frames.to_unit(several))

    np.testing.assert_allclose(found, several, rtol=0, atol=1e-11)


def test_a_motion_of_the_caller_does_to_the_unit_source_what_it_does_to_the_source():
    source, points = shifted(solids.lopsided(200, 0), FAR)
    target = PointCloud(solids.move(solids.motion(40), points))
    frames = units.unit_frames(source, target, None)
    motion = solids.motion(33, translation=(3, 2, 1))

    between = frames.to_unit(motion)

    moved = solids.move(between, (points - frames.source_center) / frames.scale)
    wanted = solids.move(motion, points)
    np.testing.assert_allclose(frames.target_center + frames.scale * moved, wanted, atol=1e-11)


@pytest.mark.parametrize("times", [0.4, 1.0, 3.7])
def test_the_size_ratio_is_how_many_times_larger_the_source_is(times):
    points = solids.lopsided(300, 0).points

    frames = units.unit_frames(PointCloud(times * points), PointCloud(points), None)

    assert frames.size_ratio == pytest.approx(times)
    one = units.unit_frames(PointCloud(points), PointCloud(points), None)
    assert frames.scale == pytest.approx(one.scale * max(times, 1))


@pytest.mark.parametrize("times", [999.9, 1000.1])
def test_an_initial_motion_may_leave_clouds_a_thousand_radii_apart_and_no_more(times):
    cloud = PointCloud(solids.lopsided(200, 0).points)
    initial = np.eye(4)
    initial[0, 3] = times * units.unit_frames(cloud, cloud, None).scale

    if times < 1000:
        units.unit_frames(cloud, cloud, initial)
    else:
        with pytest.raises(ValueError, match="^initial: leaves the source .* 1000 times the rad"):
            units.unit_frames(cloud, cloud, initial)


@pytest.mark.parametrize("with_normals", [False, True])
def test_thinning_a_unit_cloud_keeps_some_of_its_points_where_they_are(with_normals):
    given = solids.lopsided(500, 0)
    cloud = PointCloud(given.points, given.normals if with_normals else None)
    whole = units.to_unit(
        cloud, np.zeros(3), 1.0, np.eye(4), budget=500, neighbors=16, radius=0.3, seed=0
    )

    few = units.thinned(whole, budget=100, neighbors=8, radius=0.5, seed=0)

    assert few.mask.sum() == len(few.rows) == 100 and few.neighbors.shape[1] == 8
    np.testing.assert_array_equal(few.points[:100], whole.points[few.rows])
    assert (few.normals is None) == (not with_normals)
    if with_normals:
        np.testing.assert_array_equal(few.normals[:100], whole.normals[few.rows])
    there = few.points[:100]
    apart = np.linalg.norm(there[few.neighbors[:100]] - there[:, None], axis=2)
    nearest = cKDTree(there).query(there, 2)[0][:, 1:]
    assert ((apart <= 0.5) | (np.abs(apart - nearest) < 1e-6)).all()


@pytest.mark.parametrize("voxel", [0.07, 0.3, 5.0])
def test_the_first_point_of_each_voxel_is_found(voxel):
    points = np.random.default_rng(0).normal(size=(500, 3)) * [3, 1, 0.3]

    found = thinning._first_of_each_voxel(points, voxel)

    first = {}
    for row, point in enumerate(points):
        first.setdefault(tuple(round(axis) for axis in point / voxel), row)
    assert sorted(found) == sorted(first.values())


def test_every_point_of_a_lattice_has_a_voxel_of_its_own():
    points = np.stack(np.meshgrid(*map(np.arange, (4, 5, 6))), -1).reshape(-1, 3).astype(float)

    assert sorted(thinning._first_of_each_voxel(points, 1.0)) == list(range(120))
