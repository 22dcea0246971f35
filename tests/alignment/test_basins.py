"""A source is turned far and brought back. If it stays turned and fits as well, it turns freely."""

import hard_cases
import numpy as np
import pytest
import solids
from scipy.spatial.transform import Rotation

from cfr_jax.alignment import basins
from cfr_jax.geometry import motions

HERE = np.eye(4)


def around(source, target, transform, *, start=HERE, within=180.0):
    return basins.Surroundings(source, target, transform, start=start, within=within)


def unit(points):
    points = points - points.mean(axis=0)
    return points / np.linalg.norm(points, axis=1).max()


def two(draw, count=500):
    source, target = (draw(count, np.random.default_rng(seed)) for seed in (1, 2))
    radius = np.linalg.norm(target, axis=1).max()
    return source / radius, target / radius


@pytest.mark.parametrize("name", hard_cases.REVOLVED)
def test_a_solid_of_revolution_turns_freely(name):
    source, target = two(hard_cases.REVOLVED[name])

    twist = around(source, target, np.eye(4)).free_turn()

    assert twist is not None
    if name not in ("sphere", "spheroid"):
        assert abs(twist[2]) > 0.9


def test_a_shape_without_symmetry_does_not():
    source, target = two(lambda count, rng: solids.lopsided(count, rng.integers(99)).points)

    assert around(source, target, np.eye(4)).free_turn() is None


def test_the_answer_does_not_depend_on_the_frame():
    source, target = two(hard_cases.REVOLVED["torus"])
    turned = solids.motion(70, translation=(0, 0, 0))

    here = around(source, target, np.eye(4)).free_turn()
    there = around(source, solids.move(turned, target), turned).free_turn()

    np.testing.assert_allclose(abs(turned[:3, :3] @ here[:3] @ there[:3]), 1, atol=0.02)


def test_closest_points_bring_a_turned_shape_back():
    points = unit(solids.lopsided(500, 0).points)
    start = motions.motion(motions.from_rotvec(np.radians([0, 0, 12.0])), np.array([0.02, 0, 0]))

    found = around(points, points, start)._ends.own.motions[1]

    assert solids.degrees_between(found, np.eye(4)) < 1


def notched(count, rng):
    """A cube with an eighth cut out: it fits on itself after thirds of a turn about one diagonal.
    All but the notch fits after quarter turns, too."""
    case = hard_cases.notched_cube("notched cube", rng, 1)
    assert len(case.source) == count
    return case.source


def about_diagonal(degrees):
    return motions.motion(motions.from_rotvec(np.radians(degrees) * np.ones(3) / np.sqrt(3)))


def test_a_notched_cube_has_rivals_a_third_of_a_turn_away():
    source, target = two(notched)

    found = around(source, target, np.eye(4)).rivals()

    thirds = [about_diagonal(turn) for turn in (120, 240)]
    assert len(found) >= 1
    for motion in found:
        assert min(solids.degrees_between(motion, third) for third in thirds) < 5


def test_a_rival_beyond_the_reach_does_not_count():
    source, target = two(notched)

    assert len(around(source, target, np.eye(4), within=90.0).rivals()) == 0
    # from a start in between, one of them is within reach
    between = around(source, target, np.eye(4), start=about_diagonal(60), within=90.0)
    (found,) = between.rivals()
    assert solids.degrees_between(found, about_diagonal(120)) < 5


def test_a_better_place_is_a_rival_and_comes_first():
    source, target = two(notched)
    wrong = motions.motion(motions.from_rotvec(np.radians([0, 0, 90.0])))

    found = around(source, target, wrong, within=90.0).rivals()

    assert solids.degrees_between(found[0], np.eye(4)) < 5


def test_a_shape_without_symmetry_has_no_rivals():
    source, target = two(lambda count, rng: solids.lopsided(count, rng.integers(99)).points)

    found = around(source, target, np.eye(4)).rivals()

    assert found.shape == (0, 4, 4)


def test_no_rotation_is_far_from_those_that_are_tried():
    anywhere = Rotation.random(2000, random_state=0).as_matrix()
    trace = np.einsum("aij,bij->ab", anywhere, basins._ROTATIONS)
    farthest = np.degrees(np.arccos(np.clip((trace.max(axis=1) - 1) / 2, -1, 1))).max()

    assert farthest < 28
