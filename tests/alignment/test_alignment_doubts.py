"""Answers that `align` does not trust: shapes that move freely, different things, few points."""

import dataclasses

import numpy as np
import pytest
import solids

from cfr_jax.alignment import doubts
from cfr_jax.alignment.align import align
from cfr_jax.io import PointCloud
from cfr_jax.networks.probability import calibration_of
from cfr_jax.weights.files import load_params

TRUTH = solids.motion(25)


@pytest.fixture(scope="module")
def pair():
    """Two noisy samplings of one shape, with the target moved by TRUTH."""
    return solids.two_samplings(500, TRUTH)


FREE = {
    "plane": (solids.plane, {"slide along": [2], "turn about": [0, 1]}),
    "cylinder": (solids.cylinder, {"slide along": [0, 1], "turn about": [0, 1]}),
    "sphere": (solids.sphere, {"slide along": [0, 1, 2], "turn about": []}),
    "line": (solids.line, {"slide along": [1, 2], "turn about": [1, 2]}),
}


@pytest.mark.parametrize("noise", [0.0, 0.003])
@pytest.mark.parametrize("shape", FREE)
def test_a_shape_that_moves_freely_is_not_trusted_and_the_axis_named(shape, noise):
    make, held = FREE[shape]
    source, target = (make(500, seed, noise).points for seed in (0, 1))

    found = align(source, target)

    assert not found.determined and not found.trusted
    [warning] = [text for text in found.warnings if "do not determine" in text]
    verb = next(verb for verb in held if verb in warning)
    axis = np.array([float(part) for part in warning.split("(")[1].split(")")[0].split(",")])
    assert np.linalg.norm(axis) == pytest.approx(1, abs=0.02)
    assert all(abs(axis[place]) < 0.2 for place in held[verb])


# Spheres are left out: the 500 samples themselves determine the motion, and the answer is right.
@pytest.mark.parametrize("shape", ["plane", "cylinder", "line"])
def test_the_same_samples_of_a_free_shape_are_not_trusted_either(shape):
    points = FREE[shape][0](500, 0).points

    assert not align(points, solids.move(TRUTH, points)).trusted


def test_identical_clouds_stay_where_they_are(pair):
    found = align(pair[0], pair[0])

    np.testing.assert_allclose(found.transform, np.eye(4), atol=1e-5)
    assert found.fitness == 1 and found.inlier_rmse < 1e-5 and found.determined


@pytest.mark.parametrize("other", ["sphere", "plane", "cylinder", "line"])
def test_two_different_things_are_not_trusted(pair, other):
    found = align(pair[0], FREE[other][0](500, 0).points)

    assert not found.trusted and found.warnings


@pytest.mark.parametrize("scale", [1e-9, 1e-3, 1e3])
def test_clouds_in_different_units_are_not_trusted(pair, scale):
    found = align(pair[0] * scale, pair[1])

    assert not found.trusted and np.isfinite(found.transform).all()


@pytest.mark.parametrize(
    ("ratio", "said"),
    [
        (1000.0, "source is in millimeters and the target in meters, multiply the source by 0.001"),
        (830.0, "source is in millimeters and the target in meters, multiply the source by 0.001"),
        (1e-3, "multiply the source by 1000"),
        (
            10.0,
            "source is in millimeters and the target in centimeters, multiply the source by 0.1",
        ),
        (25.4, "source is in millimeters and the target in inches, multiply the source by 0.03937"),
    ],
)
def test_units_that_would_fit_are_named_with_their_factor(ratio, said):
    [told] = doubts.warnings_of(None, (), 0.9, 0.9, 64, ratio, False)

    assert "same units?" in told and said in told


def test_no_unit_is_named_where_none_fits():
    [told] = doubts.warnings_of(None, (), 0.9, 0.9, 64, 1e-9, False)

    assert told.endswith("same units?")


def test_points_in_two_places_turn_freely_about_their_line():
    points = np.repeat([[0.0, 0, 0], [0, 2, 0]], 250, axis=0)

    found = align(points, points)

    assert not found.determined and "turn about (0.00, 1.00, 0.00)" in found.warnings[0]


@pytest.mark.parametrize("count", [3, 20])
def test_small_clouds_have_fewer_neighbors_and_it_says_so(count):
    points = solids.lopsided(count, 0).points

    found = align(points, solids.move(TRUTH, points))

    assert found.neighbors == count - 1
    assert any(f"{count - 1} neighbors per point instead of 64" in w for w in found.warnings)
    assert not found.trusted or solids.degrees_between(found.transform, TRUTH) < 5


def test_where_clouds_hardly_meet_the_fitness_bounds_the_confidence():
    fitted = calibration_of(load_params())
    weights = dict(fitted.align)
    sure, unsure = (dict.fromkeys(weights, 0.0) for _ in range(2))
    sure["settled"], unsure["settled"] = (
        (logit - weights["bias"]) / weights["settled"] for logit in (4.6, -2.9)
    )

    assert doubts.probability(fitted, sure, 0.6) == pytest.approx(0.99, abs=1e-3)
    assert doubts.probability(fitted, sure, 0.1) == 0.1
    assert doubts.probability(fitted, unsure, 0.1) == pytest.approx(0.052, abs=1e-3)


def test_rivals_and_few_inliers_bound_the_confidence():
    fitted = calibration_of(load_params())
    weights = dict(fitted.align)
    sure = dict.fromkeys(weights, 0.0) | {"settled": (4.6 - weights["bias"]) / weights["settled"]}

    told = [doubts.probability(fitted, sure, 0.6, 500.0, rivals) for rivals in range(3)]
    few, more = (doubts.probability(fitted, sure, 0.6, inliers) for inliers in (10.0, 40.0))

    assert told == pytest.approx([0.99, 1 / 2, 1 / 3], abs=1e-3)
    assert few == pytest.approx(1 - np.exp(-1 / 3)) and few < doubts.TRUSTED < more < 0.75


def test_an_answer_with_rivals_is_not_trusted(pair):
    found = align(*pair)

    assert found.trusted
    assert not dataclasses.replace(found, alternatives=np.eye(4)[None]).trusted


def test_placeholder_normals_are_dropped_and_that_is_said(pair):
    with_normals = (PointCloud(points, np.tile([0.0, 0, 1], (500, 1))) for points in pair)

    found = align(*with_normals)

    assert np.array_equal(found.transform, align(*pair).transform)
    assert sum("contradict its points" in text for text in found.warnings) == 2


def test_points_far_out_are_counted(pair):
    spoiled = pair[0].copy()
    spoiled[::50] *= 400

    found = align(spoiled, pair[1])

    assert "10 of the 500 points of the source lie far out" in found.warnings[0]
    assert solids.degrees_between(found.transform, TRUTH) < 2


def test_who_tried_one_start_is_told_of_the_search():
    alone, searched = (
        doubts.warnings_of(None, (), 0.2, 0.5, 64, 1.0, everywhere) for everywhere in (False, True)
    )

    assert "--global" in alone[0] and "--global" not in searched[0]
