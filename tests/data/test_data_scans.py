import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfr_jax.data.scans import estimate_normals, refine_point_to_plane, voxel_mean


def motion(degrees, translation, axis=(1.0, 2.0, 3.0)):
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(
        np.radians(degrees) * np.asarray(axis) / np.linalg.norm(axis)
    ).as_matrix()
    out[:3, 3] = translation
    return out


def room(count, seed, walls=(0, 1, 2)):
    """Points on three faces of a 10 m cube that meet at the origin, and their normals."""
    rng = np.random.default_rng(seed)
    face = rng.choice(walls, count)
    points = rng.uniform(0.3, 10, (count, 3))
    points[np.arange(count), face] = 0.0
    return points, np.eye(3)[face]


def test_voxels_hold_the_mean_of_their_points():
    points = np.random.default_rng(0).uniform(-3, 3, (500, 3)).astype(np.float32)

    thinned = voxel_mean(points, 1.0)

    held = {}
    for point in points:
        cube = tuple(np.floor((point.astype(float) - points.min(0)) / 1.0 + 0.5))
        held.setdefault(cube, []).append(point)
    wanted = np.array([np.mean(held[cube], axis=0) for cube in sorted(held)])
    np.testing.assert_allclose(thinned, wanted, atol=1e-6)
    assert thinned.dtype == np.float32


def test_a_voxel_far_from_the_origin_keeps_its_millimeters():
    points = np.array([[5e6, 4e5, 100.0], [5e6 + 0.002, 4e5, 100.0]])

    np.testing.assert_allclose(voxel_mean(points, 0.3), [[5e6 + 0.001, 4e5, 100.0]], atol=1e-9)


def test_normals_of_planes_are_recovered_and_face_the_sensor():
    points, wanted = room(2000, seed=0)
    inside = (points[:, None] < 1.0).sum(axis=(1, 2)) < 2  # away from the edges between the faces

    normals = estimate_normals(points, radius=1.0, viewpoint=(5.0, 5.0, 5.0))

    np.testing.assert_allclose(normals[inside], wanted[inside], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)


def test_the_number_of_neighbors_is_limited_to_the_nearest():
    rng = np.random.default_rng(0)
    near = np.concatenate([rng.uniform(-0.1, 0.1, (10, 2)), np.zeros((10, 1))], axis=1)
    far = rng.normal(size=(200, 3)) + [3.0, 0.0, 0.0]

    normals = estimate_normals(np.concatenate([near, far]), radius=10.0, most=10)

    np.testing.assert_allclose(np.abs(normals[:10]), [[0, 0, 1]] * 10, atol=1e-9)


def test_lonely_points_have_finite_unit_normals():
    points = np.array([[0.0, 0, 0], [100.0, 0, 0], [100.1, 0, 0]])

    normals = estimate_normals(points, radius=1.0)

    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)


def test_refinement_recovers_the_motion_between_two_samples_of_one_room():
    target, normals = room(4000, seed=1)
    points, _ = room(1500, seed=2)
    truth = motion(20, [1.0, -2.0, 0.5])
    back = np.linalg.inv(truth)
    source = points @ back[:3, :3].T + back[:3, 3]

    refined = refine_point_to_plane(source, target, normals, motion(3, 0.3, (0, 1, 1)) @ truth, 1.0)

    np.testing.assert_allclose(refined.transform, truth, atol=1e-6)
    assert refined.fitness > 0.99


def test_fitness_is_the_share_of_the_source_within_the_threshold():
    target, normals = room(4000, seed=1)
    source = np.concatenate([room(700, seed=2)[0], np.full((300, 3), 50.0)])

    refined = refine_point_to_plane(source, target, normals, np.eye(4), 1.0)

    assert refined.fitness == pytest.approx(0.7)
    np.testing.assert_allclose(refined.transform, np.eye(4), atol=1e-6)


def test_directions_that_the_planes_do_not_constrain_keep_their_value():
    target, normals = room(4000, seed=1, walls=(2,))
    source = room(1000, seed=2, walls=(2,))[0] + [0.0, 0.0, 0.2]
    initial = motion(0, [0.1, -0.1, 0.0])

    refined = refine_point_to_plane(source, target, normals, initial, 1.0)

    np.testing.assert_allclose(refined.transform, motion(0, [0.1, -0.1, -0.2]), atol=1e-9)


def test_clouds_that_never_meet_get_fitness_zero():
    target, normals = room(100, seed=1)

    refined = refine_point_to_plane(target + 1000, target, normals, np.eye(4), 1.0)

    assert refined.fitness == 0
    np.testing.assert_array_equal(refined.transform, np.eye(4))
