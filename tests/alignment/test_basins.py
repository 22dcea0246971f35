"""A source is turned far and brought back. If it stays turned and fits as well, it turns freely."""

import hard_cases
import numpy as np
import pytest
import solids

from cfr_jax.alignment import basins, doubts
from cfr_jax.geometry import motions

RNG = np.random.default_rng(0)


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

    twist = basins.free_turn(source, target, np.eye(4))

    assert twist is not None
    if name not in ("sphere", "spheroid"):
        assert abs(twist[2]) > 0.9


def test_a_shape_without_symmetry_does_not():
    source, target = two(lambda count, rng: solids.lopsided(count, rng.integers(99)).points)

    assert basins.free_turn(source, target, np.eye(4)) is None


def test_the_answer_does_not_depend_on_the_frame():
    source, target = two(hard_cases.REVOLVED["torus"])
    turned = solids.motion(70, translation=(0, 0, 0))

    here = basins.free_turn(source, target, np.eye(4))
    there = basins.free_turn(source, solids.move(turned, target), turned)

    np.testing.assert_allclose(abs(turned[:3, :3] @ here[:3] @ there[:3]), 1, atol=0.02)


def test_closest_points_bring_a_turned_shape_back():
    points = unit(solids.lopsided(500, 0).points)
    start = motions.motion(motions.from_rotvec(np.radians([0, 0, 12.0])), np.array([0.02, 0, 0]))
    trees = basins.Tree(points), basins.Tree(points)

    found = basins._settled(*trees, start, 0.05)

    assert solids.degrees_between(found, np.eye(4)) < 1


def test_what_lies_near_the_axis_is_nudged_further_until_it_resists(monkeypatch):
    # given a long, thin bar: under a turn about its length, points move by a tenth of the angle
    source, target = (RNG.uniform(-1, 1, (800, 3)) * [1.0, 0.12, 0.06] for _ in range(2))
    about = np.eye(6)[:1]

    (found,) = basins.resistance(source, target, np.eye(4), about)
    monkeypatch.setattr(basins, "_FARTHEST", 1)  # nudged by the usual size only
    (usual,) = basins.resistance(source, target, np.eye(4), about)

    assert usual < doubts.FREE < found


@pytest.mark.parametrize("twist", [[0, 0, 1, 0, 0, 0], [0, 0, 0, 0, 0, 1]])
def test_a_tube_is_still_free_when_nudged_further(twist):
    source, target = (solids.cylinder(500, seed).points for seed in (0, 1))

    assert basins.resistance(source, target, np.eye(4), np.array([twist], float)) < doubts.FREE
