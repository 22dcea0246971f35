"""The factor of scale between two clouds: given, estimated, and in doubt."""

import dataclasses

import numpy as np
import pytest
import solids

from cfr_jax.alignment import doubts
from cfr_jax.alignment.align import align
from cfr_jax.alignment.scaling import ratios
from cfr_jax.alignment.scaling.certainty import certainty
from cfr_jax.batch.stream import align_many
from cfr_jax.geometry import motions
from cfr_jax.io import PointCloud
from cfr_jax.refine.similarity import Similarity
from cfr_jax.refine.surfaces import HostSurface

TRUTH = solids.motion(25)


@pytest.fixture(scope="module")
def pair():
    """Two noisy samplings of one shape, with the target moved by TRUTH."""
    return solids.two_samplings(500, TRUTH)


@pytest.fixture(scope="module")
def estimated(pair):
    """The answer for a source in millimeters and a target in meters."""
    return align(1000 * pair[0], pair[1], scale="auto")


def corner(count, seed):
    """Three faces of a cube that meet, with a little noise."""
    rng = np.random.default_rng(seed)
    points = rng.random((count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = 0
    return points + 0.005 * rng.normal(size=points.shape)


def cone(count, seed):
    """The side of a cone, with a little noise."""
    rng = np.random.default_rng(seed)
    height, angle = np.sqrt(rng.random(count)), rng.uniform(0, 2 * np.pi, count)
    around = 0.6 * np.stack([np.cos(angle), np.sin(angle)]) * height
    return np.vstack([around, height]).T + 0.005 * rng.normal(size=(count, 3))


# --- a factor that is given ---


def test_a_given_factor_is_the_same_as_scaling_by_hand(pair):
    by_hand = align(0.5 * pair[0], pair[1])

    found = align(*pair, scale=0.5)

    assert found.scale == 0.5 and found.scale_confidence is None
    assert dataclasses.replace(found, scale=1.0) == by_hand


def test_without_a_factor_the_similarity_is_the_transform(pair):
    found = align(*pair)

    assert found.scale == 1.0 and found.scale_confidence is None
    assert np.array_equal(found.similarity, found.transform)


@pytest.mark.parametrize("scale", [0, -1.0, np.nan, np.inf, True, None, "Auto", [1.0], 1e-13])
def test_a_factor_that_is_none_is_refused(pair, scale, unchecked):
    with pytest.raises(ValueError, match='scale: got .*, wanted "auto" or a number'):
        align(*pair, scale=scale)
    with pytest.raises(ValueError, match='scale: got .*, wanted "auto" or a number'):
        align_many([], scale=scale)


def test_a_factor_that_makes_the_coordinates_too_large_is_refused(pair):
    with pytest.raises(ValueError, match="scale: got 1e\\+12, .* no usable coordinates"):
        align(1e3 * pair[0], pair[1], scale=1e12)


def test_an_unknown_factor_and_initial_motions_exclude_each_other(pair):
    with pytest.raises(ValueError, match='scale: got "auto" with initial motions'):
        align(*pair, scale="auto", initial=np.eye(4))


def test_many_pairs_take_the_same_factors(pair, estimated):
    [given] = align_many([pair], scale=0.5)
    [found] = align_many([(1000 * pair[0], pair[1])], scale="auto")

    assert given.alignment.scale == 0.5 and found.alignment.scale == estimated.scale
    np.testing.assert_allclose(found.alignment.similarity, estimated.similarity, atol=1e-5)


# --- a factor that is estimated ---


def test_millimeters_onto_meters_are_found_exactly(pair, estimated):
    assert estimated.scale == 0.001 and estimated.scale_confidence > 0.9 and estimated.trusted
    assert motions.are_rigid(estimated.transform)
    assert solids.degrees_between(estimated.transform, TRUTH) < 1
    moved = solids.move(estimated.similarity, 1000 * pair[0])
    assert np.abs(moved - solids.move(TRUTH, pair[0])).max() < 0.02


@pytest.mark.parametrize("factor", [0.01, 0.3048, 0.0254, 12.0])
def test_ratios_of_usual_units_are_found_exactly(pair, factor):
    found = align(pair[0] / factor, pair[1], scale="auto")

    assert found.scale == pytest.approx(factor, rel=1e-9) and found.trusted


@pytest.mark.parametrize("seed", range(4))
def test_any_factor_is_found_to_one_percent_on_partial_views(seed):
    # given two views that share a little more than half of the shape
    rng = np.random.default_rng(seed)
    factor, direction = np.exp(rng.uniform(np.log(0.2), np.log(5))), rng.normal(size=3)
    source, target = (
        solids.keep_side(solids.lopsided(700, 10 * seed + side, 0.003), towards, 0.75).points
        for side, towards in ((0, direction), (1, direction + 2 * rng.normal(size=3)))
    )

    # when
    found = align(source / factor, solids.move(TRUTH, target), scale="auto")

    # then
    assert found.scale == pytest.approx(factor, rel=0.01) and found.trusted
    assert solids.degrees_between(found.transform, TRUTH) < 3


def test_map_coordinates_do_not_change_the_factor(pair, estimated):
    far = np.array([5e6, -5e6, 5e6])

    found = align(1000 * pair[0] + 1000 * far, pair[1] + far, scale="auto")

    assert found.scale == estimated.scale
    assert solids.degrees_between(found.transform, estimated.transform) < 0.01


def test_a_source_turned_far_is_found_with_its_factor_by_a_search(pair):
    truth = solids.motion(100, (0, 1, 0.3))
    target = solids.move(truth @ np.linalg.inv(TRUTH), pair[1])

    found = align(pair[0] / 3, target, scale="auto", initial="global")

    assert found.scale == pytest.approx(3, rel=0.01)
    assert solids.degrees_between(found.transform, truth) < 1


@pytest.mark.parametrize(
    "drawn",
    [lambda count, seed: solids.plane(count, seed, 0.01).points, corner, cone],
    ids=["plane", "corner", "cone"],
)
def test_shapes_that_leave_the_factor_open_are_doubted(drawn):
    found = align(drawn(500, 0) / 2, solids.move(TRUTH, drawn(500, 1)), scale="auto")

    assert found.scale_confidence < 0.5 and not found.trusted
    assert any("leave the factor of scale open" in text for text in found.warnings)


# --- how sure it is ---


@pytest.mark.parametrize(
    ("shape", "lever"), [(solids.sphere, 1.0), (solids.cylinder, 0.4), (solids.plane, 0.0)]
)
def test_the_lever_of_the_factor_is_the_radius_of_curvature(shape, lever):
    """Off a sphere or a cylinder, points move by the change of its radius; off a plane, not."""
    surface = HostSurface(*shape(400, 0))

    found = certainty(surface, surface, Similarity(1.0, np.eye(4)), 0.05)

    # the little information of the points themselves is a thousandth of their squared distances
    assert found.lever == pytest.approx(lever, abs=0.05)


def test_a_change_of_the_factor_goes_with_the_motion_that_gives_way():
    """About the tip of a cone, any change of size leaves the cone on itself."""
    points = cone(400, 0)
    angle = np.arctan2(points[:, 1], points[:, 0])
    slope = np.hypot(1, 0.6)
    normals = np.stack([np.cos(angle), np.sin(angle), np.full(400, -0.6)], axis=1) / slope
    surface = HostSurface(points - points.mean(axis=0), normals)
    found = certainty(surface, surface, Similarity(1.0, np.eye(4)), 0.05)

    changed = found.changed(Similarity(1.0, np.eye(4)), 1.2)

    tip = -points.mean(axis=0)
    assert changed.factor == pytest.approx(1.2)
    assert np.linalg.norm(solids.move(changed.matrix, tip) - tip) < 0.02


def test_nothing_is_certain_without_pairs():
    surface = HostSurface(solids.lopsided(100, 0).points)
    away = Similarity(1.0, solids.motion(0, translation=(9, 0, 0)))

    found = certainty(surface, surface, away, 0.05)

    assert found.confidence(0.0) < 0.01


def test_the_less_certain_the_smaller_the_confidence():
    surface = HostSurface(*solids.lopsided(400, 0, 0.003))
    found = certainty(surface, surface, Similarity(1.0, np.eye(4)), 0.05)

    by_spread = [found._replace(slack=0.06).confidence(spread) for spread in (0.0, 0.1, 1.0)]
    by_slack = [found._replace(slack=slack).confidence(0.0) for slack in (0.03, 0.06, 0.2)]

    for told in (by_spread, by_slack):
        assert 1 > told[0] > told[1] > told[2] > 0
    assert by_slack[0] > 0.95 and by_slack[2] < 0.1


# --- usual ratios, and what is said of sizes ---


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (0.001, "millimeters to meters"),
        (0.0254, "inches to meters"),
        (0.3048, "feet to meters"),
        (12.0, "feet to inches"),
        (1.0, ""),
        (0.7, ""),
    ],
)
def test_the_units_of_a_usual_ratio_are_named(factor, words):
    assert ratios.in_words(factor) == words


@pytest.mark.parametrize("sparser", [0.5, 1.0, 2.0])
def test_units_are_named_where_sizes_and_spacings_differ_alike(sparser):
    told = doubts.warnings_of(None, (), 0.9, 0.9, 64, 800.0, False, (), 1000.0 * sparser)

    assert "same units?" in told[0] and 'scale=0.001, or scale="auto"' in told[0]


def test_a_part_of_a_large_scene_is_not_said_to_have_another_unit():
    scene = solids.plane(4000, 0, 0.01).points
    part = scene[np.linalg.norm(scene, axis=1) < 0.12]

    found = align(part, scene)

    [told] = [text for text in found.warnings if "times as large" in text]
    assert "points as dense" in told and "unit" not in told


def test_the_same_scan_in_another_unit_is_said_to_have_one(pair):
    found = align(1000 * pair[0], PointCloud(pair[1]))

    assert any("multiply the source by 0.001" in text for text in found.warnings)
