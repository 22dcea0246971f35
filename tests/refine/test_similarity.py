"""The refinement of a motion together with a factor of scale, against closed forms."""

import numpy as np
import pytest
import solids

from cfr_jax.refine import similarity
from cfr_jax.refine.similarity import Similarity
from cfr_jax.refine.surfaces import HostSurface


def umeyama(points, places):
    """The factor and the motion that map points onto places (Umeyama, 1991), from pairs."""
    ours, theirs = points - points.mean(axis=0), places - places.mean(axis=0)
    u, values, vt = np.linalg.svd(theirs.T @ ours)
    signs = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = u * signs @ vt
    factor = (values * signs).sum() / (ours**2).sum()
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = places.mean(axis=0) - factor * rotation @ points.mean(axis=0)
    return factor, transform


@pytest.fixture(scope="module")
def points():
    return solids.lopsided(600, 0).points - 0.3


@pytest.mark.parametrize("start", [0.85, 1.2])
def test_copies_of_the_same_points_give_the_closed_form(points, start):
    truth = Similarity(1.0, solids.motion(6, translation=(0.02, -0.03, 0.01)))
    places = solids.move(truth.motion, 0.93 * points)
    factor, motion = umeyama(points, places)

    found = similarity.refine(
        HostSurface(points), HostSurface(places), Similarity(start, np.eye(4))
    )

    assert found.factor == pytest.approx(factor, rel=1e-4) == pytest.approx(0.93)
    assert np.abs(found.motion - motion).max() < 1e-4


def test_the_matrix_scales_first_and_then_moves(points):
    found = Similarity(2.0, solids.motion(40))

    moved = solids.move(found.matrix, points)

    np.testing.assert_allclose(moved, solids.move(found.motion, 2 * points), atol=1e-12)


def test_a_kept_factor_stays_while_the_motion_is_found(points):
    truth = solids.motion(6, translation=(0.02, -0.03, 0.01))
    sides = HostSurface(points), HostSurface(solids.move(truth, points))

    found = similarity.refine(*sides, Similarity(1.0, np.eye(4)), keep_factor=True)

    assert found.factor == 1.0
    assert np.abs(found.motion - truth).max() < 1e-4


def test_the_equations_are_the_derivatives_of_the_squared_distances(points):
    # given pairs, and their distances along normals and between the points themselves
    rng = np.random.default_rng(0)
    places, normals = points + 0.1 * rng.normal(size=points.shape), rng.normal(size=points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    weights, center = rng.random(len(points)), np.array([0.1, 0.2, -0.1])
    pairs = similarity.Pairs(points, places, normals, weights, weights)

    def loss(step):
        found = similarity.moved_by(Similarity(1.0, np.eye(4)), step, center)
        off = solids.move(found.matrix, points) - places
        plane = ((off * normals).sum(axis=1) ** 2) @ weights
        return (plane + 1e-3 * ((off**2).sum(axis=1) @ weights)) / 2

    # when
    _, pull = similarity.equations(pairs, weights, center)

    # then
    nudges = 1e-5 * np.eye(7)
    slopes = [(loss(nudge) - loss(-nudge)) / 2e-5 for nudge in nudges]
    np.testing.assert_allclose(pull, slopes, rtol=1e-5, atol=1e-6)


def test_the_misfit_is_zero_for_copies_and_one_far_away(points):
    sides = HostSurface(points), HostSurface(points)

    near, far = (
        similarity.misfit(*sides, Similarity(1.0, solids.motion(0, translation=shift)), 0.05)
        for shift in ((0, 0, 0), (9, 0, 0))
    )

    assert near == pytest.approx(0, abs=1e-12) and far == 1


def test_a_smaller_source_on_a_part_of_the_target_is_a_misfit(points):
    sides = HostSurface(points), HostSurface(points)

    small = similarity.misfit(*sides, Similarity(0.1, np.eye(4)), 0.05)

    assert small > 0.4  # the target's points are not covered, whatever the source's are


def test_nothing_moves_where_no_points_meet(points):
    start = Similarity(1.0, solids.motion(0, translation=(50, 0, 0)))

    found = similarity.refine(HostSurface(points), HostSurface(points), start)

    assert found is start
