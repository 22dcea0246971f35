"""Joint refinement brings scans of a known surface back to their places."""

from __future__ import annotations

import numpy as np
import pytest
from multiway_samples import all_pairs, distances, first_only, scans_of_a_solid

from cfr_jax.geometry import motions, twists
from cfr_jax.multiway import contact, joint


@pytest.fixture(scope="module")
def solid():
    return scans_of_a_solid(5, seed=0)


def test_scans_moved_a_little_come_back_together(solid):
    # given
    scans, poses = solid
    off = np.random.default_rng(1).normal(0, 0.02, (5, 6))
    off[0] = 0
    # when
    found = joint.refine(scans, poses @ twists.exp(off), np.array(all_pairs(5)), first_only(5))
    # then
    assert distances(poses @ twists.exp(off), poses)[1:].mean() > 0.03
    assert distances(found, poses).max() < 0.006


def test_the_slopes_of_a_contact_are_those_of_finite_differences(solid):
    # given
    scans, poses = solid
    source, target = scans[0], scans[1]
    between = motions.inverse(poses[1]) @ poses[0]
    found = contact.touching(source, target, between, 0.1, 300)
    planes = found.target_rows[:, 3:]
    # when: the pairs do not change
    partners = heights_at(source, target, between, planes, np.zeros(6), np.zeros(6), 0.1)
    size = 1e-6
    for row in range(6):
        step = size * np.eye(6)[row]
        own = heights_at(source, target, between, planes, step, np.zeros(6), 0.1)
        theirs = heights_at(source, target, between, planes, np.zeros(6), step, 0.1)
        # then
        np.testing.assert_allclose((own - partners) / size, found.rows[:, row], atol=1e-4)
        np.testing.assert_allclose((theirs - partners) / size, found.target_rows[:, row], atol=1e-4)


def heights_at(source, target, between, planes, own, theirs, reach):
    """The distances to the planes of the pairs at `between`, after a twist of the source and one of
    the target. This oracle computes them point by point."""
    made = []
    row = 0
    for point, normal in zip(source.points[:300], source.normals[:300], strict=True):
        moved = motions.apply(between, point)
        distance, index = target.tree.query(moved)
        plane = target.normals[index]
        if distance >= reach or abs(plane @ (between[:3, :3] @ normal)) < 0.5:
            continue
        np.testing.assert_allclose(planes[row], -plane)
        motion = twists.inverse(twists.exp(theirs)) @ between @ twists.exp(own)
        made.append(plane @ (motions.apply(motion, point) - target.points[index]))
        row += 1
    return np.array(made)


def test_a_plane_leaves_its_slides_and_its_turn_open():
    # given: two samples of one plane
    scans, _ = scans_of_a_solid(2, seed=3, flat=True)
    # when
    information, _ = contact.information(scans[0], scans[1], np.eye(4), 0.1)
    spread = np.sqrt(np.diag(np.linalg.inv(information)))
    # then: turn about z, and slides along x and y
    held, open_ = spread[[0, 1, 5]], spread[[2, 3, 4]]
    assert open_.min() > 10 * held.max()


def test_poses_that_already_fit_stay_about_where_they_are(solid):
    scans, poses = solid
    found = joint.refine(scans, poses, np.array(all_pairs(5)), first_only(5))
    assert distances(found, poses).max() < 0.006
