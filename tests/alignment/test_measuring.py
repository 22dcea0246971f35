"""What `align` does on all points by default, and whether oracles confirm what it reports."""

import numpy as np
import pytest
import solids
from scipy.spatial import cKDTree

from cfr_jax.alignment.align import align
from cfr_jax.alignment.measuring import measure
from cfr_jax.batch.stream import align_many
from cfr_jax.refine.surfaces import HostSurface

TRUTH = solids.motion(25, translation=(3.0, -2.0, 1.0))
CENTER = np.array([300.0, -20.0, 5.0])


@pytest.fixture(scope="module")
def pair():
    """Clouds far from the origin, with more points than the network sees in these tests."""
    source, target = (solids.lopsided(3000, seed, 0.003).points for seed in (0, 1))
    return source, solids.move(TRUTH, target) + CENTER


WANTED = TRUTH.copy()
WANTED[:3, 3] += CENTER


@pytest.fixture(scope="module")
def found(pair):
    return align(*pair, max_points=500)


@pytest.fixture(scope="module")
def thinned(pair):
    return align(*pair, max_points=500, all_points=False)


def off(transform, points):
    """The mean distance of the moved points from their true places."""
    away = solids.move(transform, points) - solids.move(WANTED, points)
    return np.linalg.norm(away, axis=1).mean()


def test_all_points_are_used_without_asking_and_make_it_more_exact(pair, found, thinned):
    assert off(found.transform, pair[0]) < 2e-3 < off(thinned.transform, pair[0])
    assert found.refined and found.converged and found.steps > thinned.steps
    np.testing.assert_array_equal(found.transforms, thinned.transforms)


def test_the_confidence_stays_that_of_the_points_that_the_network_saw(found, thinned):
    assert found.clues == thinned.clues and found.confidence == thinned.confidence
    np.testing.assert_array_equal(found.source_rows, thinned.source_rows)


def test_fitness_error_and_overlap_are_those_of_all_points(pair, found):
    away, _ = cKDTree(pair[1]).query(solids.move(found.transform, pair[0]))
    near = away[away <= found.inlier_distance]
    spacing = np.median(cKDTree(pair[1]).query(pair[1], 2)[0][:, 1])

    assert found.fitness == pytest.approx(len(near) / len(away), abs=1e-9)
    assert found.inlier_rmse == pytest.approx(np.sqrt(np.mean(near**2)), rel=1e-6)
    assert found.overlap == pytest.approx(np.mean(away <= 2 * spacing), abs=1e-3)


def test_open3d_measures_the_same(pair, found):
    registration = pytest.importorskip("open3d").pipelines.registration
    import open3d

    clouds = []
    for points in pair:
        cloud = open3d.geometry.PointCloud()
        cloud.points = open3d.utility.Vector3dVector(points)
        clouds.append(cloud)

    judged = registration.evaluate_registration(*clouds, found.inlier_distance, found.transform)
    information = registration.get_information_matrix_from_point_clouds(
        *clouds, found.inlier_distance, found.transform
    )

    assert found.fitness == pytest.approx(judged.fitness, abs=1e-9)
    assert found.inlier_rmse == pytest.approx(judged.inlier_rmse, rel=1e-6)
    np.testing.assert_allclose(found.information, information, rtol=1e-5, atol=1e-3)


def test_where_nothing_is_near_nothing_is_measured():
    far = (
        HostSurface(solids.lopsided(100, 0).points + 50),
        HostSurface(solids.lopsided(90, 1).points),
    )

    measured = measure(*far, np.eye(4), 0.05)

    assert measured.fitness == measured.inlier_rmse == measured.overlap == 0
    assert not measured.moments.any()


def test_clouds_that_the_network_saw_whole_are_not_refined_again():
    pair = solids.two_samplings(400, solids.motion(25))

    whole, used = (align(*pair, all_points=which) for which in (True, False))

    np.testing.assert_array_equal(whole.transform, used.transform)
    assert whole.steps == used.steps and whole.fitness == used.fitness


def test_the_same_call_gives_the_same_bits(pair, found):
    again = align(*pair, max_points=500)

    assert again.transform.tobytes() == found.transform.tobytes()
    assert again.information.tobytes() == found.information.tobytes()


def test_many_pairs_are_refined_on_all_points_as_each_alone(pair, found, thinned):
    (many,) = align_many([pair], max_points=500)
    (coarse,) = align_many([pair], max_points=500, all_points=False)

    np.testing.assert_allclose(many.alignment.transform, found.transform, atol=1e-5)
    assert many.alignment.fitness == found.fitness
    np.testing.assert_allclose(coarse.alignment.transform, thinned.transform, atol=1e-3)


def test_a_refinement_of_all_points_cannot_do_without_them(pair):
    with pytest.raises(ValueError, match="^all_points: got False with refine='pyramid'"):
        align(*pair, refine="pyramid", all_points=False)
