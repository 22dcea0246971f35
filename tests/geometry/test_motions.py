"""Motions in numpy: compared with scipy, and checked by their invariants."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfr_jax.geometry import motions


def random_motions(count, seed=0):
    rotations = Rotation.random(count, random_state=seed).as_matrix()
    shifts = np.random.default_rng(seed).normal(size=(count, 3))
    return motions.motion(rotations, shifts)


def turned(degrees, axis=(1.0, 2.0, -2.0)):
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array(axis) / 3)
    return motions.motion(turn.as_matrix())


def test_a_motion_moves_points_and_turns_vectors_as_scipy_does():
    transform, points = random_motions(1)[0], np.random.default_rng(1).normal(size=(50, 3))
    turned = Rotation.from_matrix(transform[:3, :3]).apply(points)

    np.testing.assert_allclose(motions.rotate(transform, points), turned, atol=1e-14)
    moved = motions.apply(transform, points)
    np.testing.assert_allclose(moved, turned + transform[:3, 3], atol=1e-14)


def test_one_point_is_moved_as_if_it_were_among_many():
    transform, points = random_motions(1)[0], np.random.default_rng(1).normal(size=(50, 3))

    one = [motions.apply(transform, point) for point in points]

    np.testing.assert_allclose(one, motions.apply(transform, points), atol=1e-15)


def test_the_inverse_undoes_a_motion_in_its_own_precision():
    transform = random_motions(1)[0]

    back = motions.inverse(transform)

    np.testing.assert_allclose(back @ transform, np.eye(4), atol=1e-15)
    assert motions.inverse(transform.astype(np.float32)).dtype == np.float32


@pytest.mark.parametrize("degrees", [0.0, 1e-9, 1e-3, 1.0, 90.0, 179.0])
def test_the_angle_is_that_of_the_rotation_between_two_motions(degrees):
    first = random_motions(1)[0]
    second = first @ turned(degrees)

    found = motions.angle_between(first, second)

    np.testing.assert_allclose(found, degrees, rtol=1e-9, atol=1e-13)


def test_the_angle_reaches_half_a_turn_and_takes_several_motions():
    both = np.stack([np.eye(4), turned(180)])

    found = motions.angle_between(both, np.stack([np.eye(4)] * 2))

    np.testing.assert_allclose(found, [0, 180], atol=1e-5)


def test_the_nearest_rotation_matches_scipys_fit():
    matrices = np.random.default_rng(0).normal(size=(200, 3, 3))  # half of them are reflections

    found = motions.nearest_rotation(matrices)

    assert (np.linalg.det(matrices) < 0).sum() > 50
    for matrix, rotation in zip(matrices, found, strict=True):
        oracle = Rotation.align_vectors(matrix.T, np.eye(3))[0].as_matrix()
        np.testing.assert_allclose(rotation, oracle, atol=1e-9)


def test_the_nearest_motion_leaves_motions_alone_and_repairs_float32():
    transforms = random_motions(20)

    np.testing.assert_allclose(motions.nearest_motion(transforms), transforms, atol=1e-14)
    repaired = motions.nearest_motion(transforms.astype(np.float32))
    turns = repaired[:, :3, :3]
    assert np.abs(turns @ turns.swapaxes(1, 2) - np.eye(3)).max() < 1e-14
    np.testing.assert_array_equal(repaired[:, :3, 3], transforms[:, :3, 3].astype(np.float32))


def broken(**changes):
    transform = random_motions(1)[0]
    for (row, column), value in changes.pop("at").items():
        transform[row, column] = value
    return transform


BROKEN = {
    "not all numbers are finite": broken(at={(0, 3): np.nan}),
    "differs from the identity": np.diag([1.0, 1.0, 1.01, 1.0]),
    "R is a reflection": np.diag([1.0, 1.0, -1.0, 1.0]),
    "last row is": broken(at={(3, 3): 2.0}),
}


@pytest.mark.parametrize("why", BROKEN)
def test_a_matrix_that_is_not_rigid_is_refused_with_name_and_reason(why):
    with pytest.raises(ValueError, match=f"^given: got .*not rigid .*{why}.*wanted a proper"):
        motions.check_rigid("given", BROKEN[why])
    assert not motions.are_rigid(BROKEN[why])


def test_among_several_motions_the_first_bad_one_is_named():
    several = random_motions(4)
    several[2:] = BROKEN["R is a reflection"]

    assert motions.are_rigid(several).tolist() == [True, True, False, False]
    with pytest.raises(ValueError, match=r"^starts\[2\]: got .*a reflection"):
        motions.check_rigid("starts", several, several=True)
    with pytest.raises(ValueError, match=r"^start: got shape \(4, 4, 4\)"):
        motions.check_rigid("start", several)


@pytest.mark.parametrize(("scale", "rigid"), [(1 + 4e-4, True), (1 + 6e-4, False)])
def test_the_tolerance_applies_to_the_product_with_the_transpose(scale, rigid):
    transform = random_motions(1)[0]
    transform[:3, :3] *= scale  # R R' differs from I by 2 * (scale - 1)

    assert motions.are_rigid(transform) == rigid


def test_quaternions_match_scipy_in_both_directions():
    quaternions = np.random.default_rng(0).normal(size=(100, 4))

    found = motions.from_xyzw(quaternions)

    np.testing.assert_allclose(found, Rotation.from_quat(quaternions).as_matrix(), atol=1e-15)
    for quaternion, rotation in zip(quaternions, found, strict=True):
        unit = quaternion / np.linalg.norm(quaternion) * np.sign(quaternion[3])
        np.testing.assert_allclose(motions.to_xyzw(rotation), unit, atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 2.0, np.pi - 1e-9, np.pi])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, -2, 3)])
def test_quaternions_are_accurate_up_to_half_a_turn(axis, angle):
    rotation = Rotation.from_rotvec(np.array(axis) / np.linalg.norm(axis) * angle)

    found = Rotation.from_quat(motions.to_xyzw(rotation.as_matrix()))

    assert (found * rotation.inv()).magnitude() < 1e-7


@pytest.mark.parametrize("length", [0.0, 1e-9, 9.9e-4, 1.1e-3, 1.0, 3.1])
def test_rotation_vectors_match_scipy_in_both_directions(length):
    turn = length * np.array([2.0, -1.0, 2.0]) / 3

    found = motions.from_rotvec(turn)

    np.testing.assert_allclose(found, Rotation.from_rotvec(turn).as_matrix(), atol=1e-15)
    np.testing.assert_allclose(motions.to_rotvec(found), turn, atol=1e-14)
