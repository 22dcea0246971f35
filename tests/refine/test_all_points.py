"""The last refinement uses every point. It is exact, never makes the score worse, gives the same
answer twice, and works with or without its library."""

import sys

import numpy as np
import pytest
import solids
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cfr_jax.geometry import motions
from cfr_jax.refine import all_points, pyramid, surfaces
from cfr_jax.refine.surfaces import HostSurface

TRUTH = solids.motion(20, (1.0, 2.0, 3.0), (0.1, -0.05, 0.2))
START = TRUTH @ solids.motion(1.0, (1.0, -1.0, 0.5), (0.01, 0.0, -0.01))


@pytest.fixture
def library():
    pytest.importorskip("small_gicp")


def target(count, seed=1, noise=0.002):
    return HostSurface(solids.lopsided(count, seed, noise).points - 0.4)


def source(count, seed=0, noise=0.002):
    """A cloud that TRUTH maps into the target's frame."""
    return HostSurface(solids.move(np.linalg.inv(TRUTH), target(count, seed, noise).points))


def off(transform):
    """The error of a motion: degrees of rotation, and length of translation."""
    left = np.linalg.inv(TRUTH) @ transform
    return np.degrees(Rotation.from_matrix(left[:3, :3]).magnitude()), np.linalg.norm(left[:3, 3])


def test_many_points_give_an_exact_answer(library):
    fine = all_points.refine(source(3000), target(3000), START)

    degrees, length = off(fine.transform)
    assert degrees < 0.1 and length < 1e-3  # START is off by 1 degree and about 0.01
    assert fine.improved and fine.converged and fine.steps > 0
    motions.check_rigid("transform", fine.transform)


def test_clouds_of_very_many_points_are_thinned_and_hardly_less_exact(library, monkeypatch):
    monkeypatch.setattr(all_points, "MOST", 2000)
    many = source(12_000)

    fine = all_points.refine(many, target(12_000), START)

    degrees, length = off(fine.transform)
    assert degrees < 0.1 and length < 1e-3 and fine.improved
    assert 500 < all_points._level(many).cloud.size() <= 2000


def test_part_of_the_points_in_another_place_do_not_pull(library):
    still = target(3000)
    kept = still.points[:, 0] < np.quantile(still.points[:, 0], 0.7)
    still = HostSurface(np.concatenate([still.points[kept], still.points[~kept] + 0.3]))

    degrees, length = off(all_points.refine(source(3000), still, START).transform)

    assert degrees < 0.2 and length < 3e-3


@pytest.mark.parametrize("seed", range(5))
def test_it_never_scores_worse_than_its_start(library, seed):
    rng = np.random.default_rng(seed)
    moving, still = source(2000), HostSurface(solids.sphere(1500, 1).points)
    start = solids.motion(rng.uniform(0, 180), rng.normal(size=3), rng.uniform(-0.3, 0.3, 3))

    fine = all_points.refine(moving, still, start)

    tree = cKDTree(still.points)
    away = [tree.query(solids.move(motion, moving.points))[0] for motion in (start, fine.transform)]
    scores = [surfaces.score(distance, 0.05) for distance in away]
    assert scores[1] <= scores[0] + 1e-3  # `refine` judges itself by a narrower cut than 0.05
    assert fine.improved or np.array_equal(fine.transform, start)


def test_what_would_score_worse_is_not_taken(library, monkeypatch):
    import small_gicp

    class Away:
        T_target_source = solids.motion(0, translation=(1.0, 0.0, 0.0))
        converged, iterations = True, 1

    monkeypatch.setattr(small_gicp, "align", lambda *_, **__: Away)
    monkeypatch.setattr(all_points, "_SPARSE", 0)  # nothing but the library's answer

    fine = all_points.refine(source(1000), target(1000), START)

    assert not fine.improved and np.array_equal(fine.transform, START)


def test_sparse_clouds_end_halfway_to_where_planes_lead(library, monkeypatch):
    # given a last refinement that turns the answer by two degrees about the source's center, to
    # where the clouds lie nearer to each other, as the misfit says
    moving, center = source(1000), source(1000).points.mean(axis=0)
    turned = solids.motion(2, translation=(0, 0, 0))
    turned[:3, 3] = center - turned[:3, :3] @ center
    misfits = iter([0.5, 0.4])
    monkeypatch.setattr(
        all_points.similarity,
        "refine",
        lambda _, __, found, **___: found._replace(motion=found.motion @ turned),
    )
    monkeypatch.setattr(all_points.similarity, "misfit", lambda *_: next(misfits))

    # when
    found = all_points._polished(moving, target(1000), TRUTH)

    # then
    assert solids.degrees_between(found, TRUTH) == pytest.approx(1)
    np.testing.assert_allclose(solids.move(found, center), solids.move(TRUTH, center), atol=1e-12)


def test_where_planes_lead_away_nothing_changes(library, monkeypatch):
    away = solids.motion(20)
    monkeypatch.setattr(
        all_points.similarity, "refine", lambda _, __, found, **___: found._replace(motion=away)
    )

    assert all_points._polished(source(1000), target(1000), TRUTH) is TRUTH


def test_the_score_is_the_mean_of_tukeys_loss():
    away = np.array([0.0, 0.5, 1.0, 7.0])

    # 1 - (1 - d^2)^3
    assert surfaces.score(away, 1.0) == pytest.approx((0 + 1 - 0.75**3 + 1 + 1) / 4)


@pytest.mark.parametrize("away", [0.0, 5.0], ids=["the same points twice", "nothing near"])
def test_what_cannot_be_made_better_is_kept(library, away):
    still = target(1000, noise=0.0)
    moving = HostSurface(solids.move(np.linalg.inv(TRUTH), still.points + [away, 0, 0]))

    fine = all_points.refine(moving, still, TRUTH)

    np.testing.assert_allclose(fine.transform, TRUTH, atol=1e-5)


def test_the_same_clouds_give_the_same_answer_to_the_bit(library):
    answers = {
        all_points.refine(source(5000), target(5000), START).transform.tobytes() for _ in range(5)
    }

    assert len(answers) == 1


def test_without_the_library_our_own_pyramid_does_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "small_gicp", None)

    fine = all_points.refine(source(2000), target(2000), START)

    wanted = pyramid.refine(source(2000), target(2000), START)
    np.testing.assert_array_equal(fine.transform, wanted.transform)
    degrees, length = off(fine.transform)
    assert degrees < 0.15 and length < 2e-3
