"""Refinement on all points is as exact as many points allow, and never worse than its start."""

import numpy as np
import pytest
import solids
from scipy.spatial.transform import Rotation

from cfr_jax.refine import pyramid
from cfr_jax.refine.surfaces import HostSurface

TRUTH = solids.motion(20, (1.0, 2.0, 3.0), (0.1, -0.05, 0.2))


def cloud(count, seed, *, moved=False, normals=False, noise=0.002):
    points, given = solids.lopsided(count, seed, noise)
    points = points - 0.4
    if moved:  # a source, which TRUTH maps into the target's frame
        inverse = np.linalg.inv(TRUTH)
        points, given = solids.move(inverse, points), given @ inverse[:3, :3].T
    return HostSurface(points, given if normals else None, 100)


def off(transform):
    """The error of a motion: degrees of rotation, and length of translation."""
    left = np.linalg.inv(TRUTH) @ transform
    turned = Rotation.from_matrix(left[:3, :3]).magnitude()
    return np.degrees(turned), np.linalg.norm(left[:3, 3])


START = TRUTH @ solids.motion(1.0, (1.0, -1.0, 0.5), (0.01, 0.0, -0.01))


@pytest.mark.parametrize("normals", [False, True], ids=["estimated", "given"])
def test_many_points_give_an_exact_answer(normals):
    source = cloud(3000, 0, moved=True, normals=normals)
    target = cloud(3000, 1, normals=normals)

    fine = pyramid.refine(source, target, START)

    degrees, length = off(fine.transform)
    assert degrees < 0.1 and length < 1e-3  # the start is off by 1 degree and about 0.01
    assert fine.improved and fine.converged


def test_part_of_the_points_in_another_place_do_not_pull():
    source, target = cloud(3000, 0, moved=True), cloud(3000, 1)
    kept = target.points[:, 0] < np.quantile(target.points[:, 0], 0.7)
    target = HostSurface(np.concatenate([target.points[kept], target.points[~kept] + 0.3]))

    degrees, length = off(pyramid.refine(source, target, START).transform)

    assert degrees < 0.2 and length < 3e-3


@pytest.mark.parametrize("away", [0.0, 5.0], ids=["the same points twice", "nothing near"])
def test_what_cannot_be_made_better_is_kept(away):
    target = cloud(1000, 1, noise=0.0)
    source = HostSurface(solids.move(np.linalg.inv(TRUTH), target.points + [away, 0, 0]), None, 100)

    fine = pyramid.refine(source, target, TRUTH)

    assert np.isfinite(fine.transform).all()
    np.testing.assert_allclose(fine.transform, TRUTH, atol=1e-5)
