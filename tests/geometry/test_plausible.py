"""Normals that cannot be those of the points are told from those that can."""

import numpy as np
import pytest
import solids

from cfr_jax.geometry import plausible

RNG = np.random.default_rng(0)
SHAPES = {"boxes": solids.lopsided, "sphere": solids.sphere, "cylinder": solids.cylinder}
WRONG = {
    "all the same": lambda n: np.tile([0.0, 0.6, 0.8], (len(n), 1)),
    "chance": lambda n: RNG.normal(size=n.shape),
    "colors": lambda n: RNG.uniform(0.01, 1, n.shape),
}


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("count", [200, 1000, 9000])
@pytest.mark.parametrize("shape", SHAPES)
def test_exact_normals_are_kept_whatever_their_signs(shape, count):
    points, normals = SHAPES[shape](count, 0, 0.002)
    signs = RNG.choice([-1.0, 1.0], (count, 1))

    assert not plausible.contradict(points, normals)
    assert not plausible.contradict(points, signs * normals)


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("shape", ["sphere", "cylinder"])
def test_other_directions_contradict_the_points(shape, wrong):
    points, normals = SHAPES[shape](500, 0, 0.002)

    assert plausible.contradict(points, unit(WRONG[wrong](normals)))


def test_one_normal_for_all_is_right_on_a_plane_across_it_alone():
    points, normals = solids.plane(300, 0, 0.002)

    assert not plausible.contradict(points, normals)
    assert plausible.contradict(points, np.tile([1.0, 0.0, 0.0], (300, 1)))


def test_few_points_and_points_in_one_place_tell_nothing():
    assert not plausible.contradict(np.zeros((100, 3)), unit(RNG.normal(size=(100, 3))))
    assert not plausible.contradict(RNG.normal(size=(20, 3)), unit(RNG.normal(size=(20, 3))))
