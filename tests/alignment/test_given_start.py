"""A given start is also refined without the network, and the better of the two answers is kept."""

import numpy as np
import pytest
import solids
from scipy.spatial import cKDTree

from cfr_jax.alignment import measuring
from cfr_jax.alignment.align import align
from cfr_jax.batch.stream import align_many
from cfr_jax.refine.surfaces import HostSurface

TRUTH = solids.motion(4, (0, 0, 1), (0.8, 0.1, 0))
# boxes on the ground: x and y of the center, and the size
_BOXES = (
    ((8, 3), (4, 2, 1.5)),
    ((-10, 4), (4, 2, 1.5)),
    ((14, -3), (5, 2, 2.5)),
    ((-6, -3), (1, 1, 3)),
    ((3, 6), (0.5, 0.5, 4)),
)
_LOW = -1.7


def street(seed):
    """Ground, two walls and some boxes, in meters. The points are dense near a scanner at the
    origin, which sees up to 30 m."""
    rng = np.random.default_rng(seed)
    count = 600
    away = np.exp(rng.uniform(np.log(2), np.log(30), 2 * count))
    angle = rng.uniform(0, 2 * np.pi, 2 * count)
    ground = np.stack([away * np.cos(angle), away * np.sin(angle), np.full(2 * count, _LOW)], 1)
    walls = [
        np.stack([rng.laplace(x, 8, count), np.full(count, y), rng.uniform(_LOW, top, count)], 1)
        for x, y, top in ((0, 9.0, 5), (5, -7.0, 3))
    ]
    boxes = []
    for place, size in _BOXES:
        unit, axis = rng.uniform(-0.5, 0.5, (100, 3)), rng.integers(0, 3, 100)
        unit[np.arange(100), axis] = np.sign(unit[np.arange(100), axis]) / 2
        boxes.append(unit * size + [*place, _LOW + size[2] / 2])
    points = np.concatenate([ground, *walls, *boxes])
    points = points[np.linalg.norm(points, axis=1) < 30]
    return points + 0.02 * rng.normal(size=points.shape)


def some(points, count=500):
    return points[np.random.default_rng(0).choice(len(points), count, replace=False)]


def quarter_seen(at):
    """A pair whose source shows only a quarter of the street, around the direction `at`, in
    degrees."""
    source, target = street(1), street(2)
    angle = np.degrees(np.arctan2(source[:, 1], source[:, 0]))
    inside = np.abs((angle - at + 180) % 360 - 180) <= 45
    return some(source[inside]), solids.move(TRUTH, some(target))


def off(transform, source):
    """The error of a motion: degrees, and meters as the mean over the points."""
    moved = solids.move(transform, source) - solids.move(TRUTH, source)
    return solids.degrees_between(transform, TRUTH), np.linalg.norm(moved, axis=1).mean()


@pytest.fixture(scope="module")
def kept():
    """A pair on which the network moves away from the truth (it slides 12 m along the street)."""
    pair = quarter_seen(60)
    return pair, align(*pair, initial=TRUTH)


def test_a_start_that_is_right_is_kept(kept):
    (source, _), found = kept

    by_network = off(found.transforms[-1], source)
    degrees, meters = off(found.transform, source)

    assert by_network[1] > 5
    assert degrees < 2 and meters < 0.5


def test_a_start_that_refinement_makes_right_is_kept(kept):
    (source, target), _ = kept
    near = solids.motion(1, (1, 0, 1), (0.3, -0.3, 0.1)) @ TRUTH

    found = align(source, target, initial=near)

    assert off(near, source)[1] > 0.3
    degrees, meters = off(found.transform, source)
    assert degrees < 2 and meters < 0.5


def test_of_several_starts_one_that_is_right_is_kept(kept):
    (source, target), _ = kept
    wrong = TRUTH @ solids.motion(120, (0, 0, 1), (3, 0, 0))

    found = align(source, target, initial=np.stack([wrong, TRUTH]))

    degrees, meters = off(found.transform, source)
    assert degrees < 2 and meters < 0.5


def test_what_is_told_belongs_to_the_motion_that_is_answered(kept):
    (source, target), found = kept

    away, rows = cKDTree(target).query(solids.move(found.transform, source))
    inlier = away <= found.inlier_distance

    assert found.fitness == pytest.approx(inlier.mean(), abs=1e-6)
    assert found.inlier_rmse == pytest.approx(np.sqrt(np.mean(away[inlier] ** 2)), rel=1e-3)
    turned = solids.degrees_between(found.transforms[-1], found.transform)
    assert found.clues["agreement"] == pytest.approx(np.log(turned + 0.1), abs=0.05)
    assert found.clues["fitness"] == pytest.approx(found.fitness, abs=0.01)
    assert found.refined
    np.testing.assert_allclose(found.information[3:, 3:], inlier.sum() * np.eye(3), atol=1e-3)


def test_many_pairs_keep_their_starts_as_each_alone(kept):
    pair, found = kept

    (outcome,) = align_many([(*pair, TRUTH)])

    np.testing.assert_allclose(outcome.alignment.transform, found.transform, atol=1e-4)


def test_the_networks_answer_is_taken_where_it_lies_better():
    truth = solids.motion(25)
    source, target = solids.two_samplings(500, truth)

    given, alone = align(source, target, initial=np.eye(4)), align(source, target)

    assert solids.degrees_between(given.transform, truth) < 1.5
    assert solids.degrees_between(given.transform, alone.transform) < 1


def test_the_misfit_looks_both_ways_as_a_kd_tree_does():
    source, target = solids.lopsided(300, 0).points, solids.lopsided(400, 1).points
    part = solids.keep_side(solids.lopsided(400, 2), (1, 0, 0), 0.4).points
    motion = solids.motion(3, translation=(0.02, 0.0, -0.01))

    def told(first, second):
        return measuring.misfit(HostSurface(first), HostSurface(second), motion, 0.05)

    def spacing(points):
        return np.median(cKDTree(points).query(points, 2)[0][:, 1])

    def loss(first, second, motion, cut):
        away = cKDTree(second).query(solids.move(motion, first))[0]
        return np.mean(1 - np.maximum(1 - (away / cut) ** 2, 0) ** 3)

    for first, second in ((source, target), (part, target), (target, part)):
        cut = min(0.05, 2 * max(spacing(first), spacing(second)))
        ways = loss(first, second, motion, cut), loss(second, first, np.linalg.inv(motion), cut)
        assert told(first, second) == pytest.approx(np.mean(ways), abs=1e-9)
    assert told(part, target) == pytest.approx(
        measuring.misfit(HostSurface(target), HostSurface(part), np.linalg.inv(motion), 0.05)
    )


def test_of_large_clouds_some_points_are_asked_about_all_of_the_other(monkeypatch):
    source, target = solids.lopsided(300, 0).points, solids.lopsided(400, 1).points
    monkeypatch.setattr(measuring, "_ASKED", 100)

    found = measuring.misfit(HostSurface(source), HostSurface(target), np.eye(4), 0.01)

    def loss(some, others):
        away = cKDTree(others).query(some)[0]
        return np.mean(1 - np.maximum(1 - (away / 0.01) ** 2, 0) ** 3)

    wanted = (loss(source[::3], target) + loss(target[::4], source)) / 2
    assert 0.1 < wanted < 1
    assert found == pytest.approx(wanted, abs=1e-9)
