"""Registration from anywhere: what the search finds, how it ranks, and which rivals it reports."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import solids
from scipy.spatial import cKDTree

from cfr_jax.alignment import doubts, quality, search, second_look, starts
from cfr_jax.alignment.align import align
from cfr_jax.alignment.case import Search
from cfr_jax.geometry.units import Frames, unit_frames
from cfr_jax.io import PointCloud
from cfr_jax.refine.surfaces import Surface

FIT = jax.jit(functools.partial(quality.mutual_fit, reach=0.2))


@pytest.fixture
def few_starts(monkeypatch):
    """Fewer starts and smaller clouds, so that the same code takes only a second."""
    monkeypatch.setattr(search, "COARSE_POINTS", 128)
    monkeypatch.setattr(starts, "COUNT", 64)


def surface(sampled):
    points, normals = (jnp.asarray(part, jnp.float32) for part in sampled)
    return Surface(points, normals, jnp.arange(len(points)) < len(points) - 8)  # eight are padding


@pytest.mark.parametrize("degrees", [100, 180])
def test_a_turn_of_any_size_is_found(few_starts, degrees):
    truth = solids.motion(degrees, (1, -1, 0.5))
    source, target = solids.two_samplings(256, truth)

    found = align(source, target, initial="global", max_points=256)

    assert solids.degrees_between(found.transform, truth) < 3
    assert (
        np.linalg.norm(
            solids.move(found.transform, source) - solids.move(truth, source), axis=1
        ).mean()
        < 0.05
    )
    assert found.seconds["run"] > 0 and found.determined


def test_an_answer_without_a_search_stands_unless_it_is_clearly_beaten(few_starts, monkeypatch):
    source, target = solids.two_samplings(256, solids.motion(20))
    plain = align(source, target)

    searched = align(source, target, initial="global", max_points=256)
    beaten = np.array([True])
    monkeypatch.setattr(second_look, "clearly_better", lambda other, case: beaten.all())
    other = align(source, target, initial="global", max_points=256)

    np.testing.assert_allclose(searched.transform, plain.transform, atol=1e-6)
    assert searched.confidence == pytest.approx(plain.confidence, abs=1e-3)
    assert searched.starts > starts.COUNT - 1 and searched.initial is None
    assert other.initial is not None


def test_what_is_not_trusted_is_searched_for_and_what_is_trusted_is_not(few_starts, monkeypatch):
    truth = solids.motion(150, (1, -1, 0.5))
    monkeypatch.setattr(starts, "around", lambda: np.eye(4)[None])  # no help from a second look
    easy = solids.two_samplings(256, solids.motion(20))
    hard = solids.two_samplings(256, truth)

    (at_once, alone), (far, once) = (
        (align(*pair, initial="auto", max_points=256), align(*pair)) for pair in (easy, hard)
    )

    assert at_once.starts == 1
    np.testing.assert_array_equal(at_once.transform, alone.transform)
    assert not once.trusted and solids.degrees_between(once.transform, truth) > 20
    assert far.starts == starts.COUNT and solids.degrees_between(far.transform, truth) < 3


def test_clouds_as_they_lie_are_a_start_where_they_meet():
    source = solids.lopsided(64, 0).points
    near, far = (source + [shift, 0.0, 0.0] for shift in (0.5, 5.0))
    frames = [unit_frames(PointCloud(source), PointCloud(target), None) for target in (near, far)]

    (found,) = starts.as_they_lie(frames[0])

    np.testing.assert_allclose(frames[0].to_caller(found), np.eye(4), atol=1e-9)
    assert np.linalg.norm(found[:3, 3]) > 0.5
    assert not len(starts.as_they_lie(frames[1]))


def test_of_several_starts_the_one_near_the_truth_is_taken(few_starts):
    truth = solids.motion(150, (0, 1, 1))
    source, target = solids.two_samplings(256, truth)
    tried = [solids.motion(angle, (1, 0, 0)) for angle in (0, 90)]
    tried.append(solids.motion(15, (1, 1, 0), (0.03, 0, 0)) @ truth)

    # as many starts as in the cover of all rotations, so that they share its compiled program
    tried = np.resize(tried, (starts.COUNT, 4, 4))
    found = align(source, target, initial=tried, max_points=256)

    assert solids.degrees_between(found.transform, truth) < 3


def test_the_fit_is_that_of_a_kd_tree():
    source, target = solids.lopsided(200, 0), solids.lopsided(300, 1)
    motion = solids.motion(8, translation=(0.02, 0, 0))

    found = FIT(surface(source), surface(target), jnp.asarray(motion, jnp.float32))

    def covered(first, second, motion):
        valid = [part[:-8] for part in first], [part[:-8] for part in second]
        away, row = cKDTree(valid[1][0]).query(solids.move(motion, valid[0][0]))
        cosine = np.sum((valid[0][1] @ motion[:3, :3].T) * valid[1][1][row], axis=1)
        return np.mean(np.maximum(1 - (away / 0.2) ** 2, 0) * np.maximum(cosine, 0))

    wanted = (covered(source, target, motion) + covered(target, source, np.linalg.inv(motion))) / 2
    assert 0.1 < wanted < 0.9
    np.testing.assert_allclose(found, wanted, atol=2e-3)


def test_answers_that_are_one_are_counted_once_and_the_best_comes_first():
    turns = [0, 5, 90, 94, 180]
    motions = jnp.asarray(np.stack([solids.motion(t) for t in turns]), jnp.float32)

    found = search._distinct(motions, jnp.array([0.2, 0.5, 0.9, 0.8, 0.1]), 4)

    np.testing.assert_allclose(found.fits, [0.9, 0.5, 0.1, -1], atol=1e-6)
    np.testing.assert_allclose(found.motions[:3], motions[jnp.array([2, 1, 4])])


def test_what_fits_as_well_another_way_is_told_and_named():
    half = solids.motion(180, (0, 0, 1), (0, 0, 0))
    shifted = solids.motion(0, translation=(0.5, 0, 0))
    motions = np.stack([np.eye(4), half, solids.motion(90, (1, 0, 0)), shifted])
    frames = Frames(np.zeros(3), np.zeros(3), 1.0, np.eye(4), 1.0)
    found = Search(motions, motions, np.array([0.8, 0.79, 0.3, 0.78]), frames, 4)

    rivals = search.rivals(found, solids.motion(3, translation=(0, 0, 0)))

    assert np.array_equal(rivals, np.stack([half, shifted]))
    assert doubts.turns(np.eye(4), rivals) == ("turned by 180° about (0.00, 0.00, 1.00)", "shifted")


def test_a_start_out_of_reach_is_refused_by_its_number():
    cloud = solids.lopsided(64, 0).points

    with pytest.raises(ValueError, match="^initial: number 1 "):
        align(
            cloud, cloud, initial=np.stack([np.eye(4), solids.motion(0, translation=(1e6, 0, 0))])
        )
