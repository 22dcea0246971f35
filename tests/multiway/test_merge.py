"""`merge` on scans with known poses: which scans it leaves out and why, and that it registers
nothing twice."""

from __future__ import annotations

import numpy as np
import pytest
import solids
from multiway_samples import views_of_a_solid

import cfr_jax
from cfr_jax.batch.journal import Journal
from cfr_jax.geometry import motions
from cfr_jax.multiway import registering
from cfr_jax.multiway.registering import Memory

COUNT = 5


@pytest.fixture(scope="module")
def views():
    return views_of_a_solid(COUNT)


@pytest.fixture(scope="module")
def kept():
    """A store of all pairs that the tests in this file register."""
    return Memory()


@pytest.fixture(scope="module")
def merged(views, kept, tmp_path_factory):
    """Five scans, and other inputs that a folder of scans may contain."""
    clouds, _ = views
    empty = tmp_path_factory.mktemp("scans") / "empty.ply"
    empty.write_bytes(b"")
    wall = solids.plane(420, seed=1, noise=0.002).points * 0.5
    return cfr_jax.merge(
        [*clouds, clouds[2], empty, wall, clouds[1] * 1000], kept=kept, reference=1
    )


def test_every_scan_is_where_it_was(merged, views):
    # given: the true poses in the frame of the second scan
    _, poses = views
    # then
    np.testing.assert_array_equal(merged.placed, [0, 1, 2, 3, 4, 5])
    np.testing.assert_allclose(merged.pose(1), np.eye(4), atol=1e-12)
    for index in range(COUNT):
        truth = motions.inverse(poses[1]) @ poses[index]
        assert motions.angle_between(merged.pose(index), truth) < 1.0
        np.testing.assert_allclose(merged.pose(index)[:3, 3], truth[:3, 3], atol=0.02)
    assert set(merged.component.tolist()) == {0} and merged.references == (1,)


def test_a_scan_that_came_twice_has_one_place_and_is_told(merged):
    np.testing.assert_array_equal(merged.pose(5), merged.pose(2))
    assert any("scan 5 has the same points as scan 2" in note for note in merged.notes)
    assert not (merged.clouds[0].scan == 5).any()


def test_what_has_no_sure_place_is_left_out_by_name_and_reason(merged):
    reasons = {each.index: each.reason for each in merged.left_out}
    assert set(reasons) == {6, 7, 8}
    assert "is empty" in reasons[6]
    assert "same units?" in reasons[8]
    assert reasons[7]
    with pytest.raises(KeyError):
        merged.pose(7)


def test_the_cloud_lies_on_the_surface_and_knows_its_scans(merged, views):
    # given
    _, poses = views
    [model] = merged.clouds
    surface = solids.lopsided(20_000, seed=99).points
    # when
    from scipy.spatial import cKDTree

    away, _ = cKDTree(surface).query(motions.apply(poses[1], model.points))
    # then
    assert np.quantile(away, 0.95) < 0.03
    assert set(model.scan.tolist()) == set(range(COUNT))
    np.testing.assert_allclose(np.linalg.norm(model.normals, axis=1), 1)


def test_kept_edges_agree_with_the_poses_and_others_say_why_not(merged):
    kept = [edge for edge in merged.edges if edge.kept]
    assert len(kept) >= COUNT
    assert all(edge.residual < 0.1 and edge.distance < 0.02 for edge in kept)
    assert all(edge.reason for edge in merged.edges if not edge.kept)


def test_the_covariance_is_about_as_large_as_the_errors(merged, views):
    _, poses = views
    for row, index in enumerate(merged.placed.tolist()):
        if index in (1, 5):
            continue
        truth = motions.inverse(poses[1]) @ poses[index]
        turned = np.radians(motions.angle_between(merged.pose(index), truth))
        spread = np.sqrt(np.trace(merged.covariances[row][:3, :3]))
        assert 0 < spread < 0.1 and turned < 5 * spread
    np.testing.assert_array_equal(merged.covariances[1], 0)


def test_nothing_is_registered_twice(views, kept, merged, monkeypatch):
    # given: all pairs are registered already
    def never(*_, **__):
        raise AssertionError("registered again")

    monkeypatch.setattr(registering, "align_many", never)
    # when
    again = cfr_jax.merge(views[0], kept=kept, fused=False)
    # then: the same places, now in the frame of the first
    np.testing.assert_array_equal(again.placed, range(COUNT))
    assert again.references == (0,) and again.clouds == ()
    relative = motions.inverse(merged.pose(0)) @ merged.pose(3)
    assert motions.angle_between(again.pose(3), relative) < 0.5


def test_a_changed_scan_is_registered_again(views, kept, merged, monkeypatch):
    asked = []
    real = registering.align_many

    def counting(pairs, **options):
        pairs = list(pairs)
        asked.extend(pairs)
        return real(pairs, **options)

    monkeypatch.setattr(registering, "align_many", counting)
    clouds = [cloud.copy() for cloud in views[0]]
    clouds[4] = clouds[4][:-5]
    cfr_jax.merge(clouds, kept=kept, fused=False)
    assert len(asked) == COUNT - 1


def test_a_journal_survives_a_kill_in_the_middle(views, tmp_path, monkeypatch):
    # given: a run that dies after four pairs
    real = registering.align_many

    def dying(pairs, **options):
        for number, outcome in enumerate(real(pairs, **options)):
            if number == 4:
                raise KeyboardInterrupt
            yield outcome

    path = tmp_path / "pairs.jsonl"
    with monkeypatch.context() as patch, Journal(path, {}, command="merge") as journal:
        patch.setattr(registering, "align_many", dying)
        with pytest.raises(KeyboardInterrupt):
            cfr_jax.merge(views[0], kept=journal)
    # when
    asked = []

    def counting(pairs, **options):
        pairs = list(pairs)
        asked.extend(pairs)
        return real(pairs, **options)

    monkeypatch.setattr(registering, "align_many", counting)
    with Journal(path, {}, command="merge") as journal:
        found = cfr_jax.merge(views[0], kept=journal)
    # then
    assert len(asked) == COUNT * (COUNT - 1) // 2 - 4
    assert len(found.placed) == COUNT


def test_a_sequence_takes_neighbors_only_and_closures_what_overlaps(views, kept, merged):
    chain = cfr_jax.merge(views[0], kept=kept, sequence=True, fused=False)
    assert {abs(edge.source - edge.target) for edge in chain.edges} == {1, 2}
    closed = cfr_jax.merge(views[0], kept=kept, sequence=True, loop_closures=True, fused=False)
    assert {abs(edge.source - edge.target) for edge in closed.edges} > {1, 2}
    np.testing.assert_array_equal(closed.placed, range(COUNT))


def test_guesses_bring_in_scans_that_lie_too_far(views):
    # given: three scans, turned by half turns
    clouds, poses = views
    turns = [np.eye(4), np.diag([-1.0, -1.0, 1.0, 1.0]), np.diag([1.0, -1.0, -1.0, 1.0])]
    turned = [motions.apply(turn, cloud) for turn, cloud in zip(turns, clouds, strict=False)]
    guesses = [pose @ motions.inverse(turn) for turn, pose in zip(turns, poses, strict=False)]
    # when
    found = cfr_jax.merge(turned, guesses=guesses, fused=False)
    # then
    np.testing.assert_array_equal(found.placed, [0, 1, 2])
    truth = motions.inverse(guesses[0]) @ guesses[2]
    assert motions.angle_between(found.pose(2), truth) < 1.0


def test_a_scan_turned_over_is_found_by_a_search_of_all_rotations(views, kept, merged):
    # given: the last scan is upside down
    clouds, poses = views
    over = np.diag([-1.0, 1.0, -1.0, 1.0])
    turned = [*clouds[:4], motions.apply(over, clouds[4])]
    # when
    without = cfr_jax.merge(turned, kept=kept, fused=False)
    found = cfr_jax.merge(turned, kept=kept, everywhere=True, fused=False)
    # then
    np.testing.assert_array_equal(without.placed, range(4))
    assert without.left_out[0].index == 4 and without.left_out[0].reason
    np.testing.assert_array_equal(found.placed, range(5))
    truth = motions.inverse(poses[0]) @ poses[4] @ motions.inverse(over)
    assert motions.angle_between(found.pose(4), truth) < 1.0


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"clouds": [np.zeros((5, 3))]}, "clouds: got 1"),
        ({"guesses": [None]}, "guesses: got 1"),
        ({"guesses": [np.eye(4), 2 * np.eye(4), None, None, None]}, r"guesses\[1\]"),
        ({"reference": 7}, "reference: got 7"),
        ({"voxel": -1.0}, "voxel: got -1.0"),
        ({"clouds": [np.zeros((50, 3))] * 3}, "at least two scans"),
    ],
)
def test_what_cannot_be_used_is_refused_by_name(options, told, views):
    options = {"clouds": views[0]} | options
    with pytest.raises(ValueError, match=told):
        cfr_jax.merge(**options)
