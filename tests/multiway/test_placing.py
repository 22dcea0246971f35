"""Wrong edges are found, components stay separate, and cycles of three confirm edges."""

from __future__ import annotations

import numpy as np
import pytest
from multiway_samples import distances, graph_of, some_poses, with_wrong

from cfr_jax.geometry import twists
from cfr_jax.multiway.pose_graph import cycles, placing, robust
from cfr_jax.multiway.pose_graph.graph import Edges


def together(first: Edges, second: Edges, shift: int) -> Edges:
    """Two graphs in one, where the scans of the second are numbered from `shift`."""
    return Edges(
        np.concatenate([first.source, second.source + shift]),
        np.concatenate([first.target, second.target + shift]),
        np.concatenate([first.transform, second.transform]),
        np.concatenate([first.information, second.information]),
    )


def sure(edges: Edges) -> tuple[np.ndarray, np.ndarray]:
    return np.full(len(edges), 0.95), np.ones(len(edges), bool)


def test_true_cycles_close_and_wrong_ones_do_not():
    # given: a third of the edges are wrong
    poses = some_poses(12, seed=2)
    edges = graph_of(poses, noise=0.02, ahead=4)
    wrong = np.random.default_rng(0).choice(len(edges), len(edges) // 3, replace=False)
    edges = with_wrong(edges, wrong, seed=1)
    # when
    found = cycles.triangles(edges)
    good = cycles.closed(edges, found)
    # then
    clean = ~np.isin(found, wrong).any(axis=1)
    assert len(found) > 20 and clean.any() and not clean.all()
    np.testing.assert_array_equal(good, clean)


def test_the_noise_around_a_cycle_is_that_of_its_edges():
    # given: cycles of three noisy edges, taken forward and backward
    count, squares = 200, []
    for seed in range(count):
        poses = some_poses(3, seed=seed)
        edges = graph_of(poses, noise=0.02, seed=seed, ahead=1)
        squares.append(bool(cycles.closed(edges, cycles.triangles(edges))[0]))
    # then: nearly all cycles close, as the limit rejects only one in ten thousand
    assert np.mean(squares) > 0.99


@pytest.mark.parametrize("seed", range(4))
def test_wrong_edges_are_all_found_and_the_poses_are_right(seed):
    # given: each scan has edges to three before and three after it; a third of all are wrong
    poses = some_poses(14, seed=seed)
    edges = graph_of(poses, noise=0.02, seed=seed)
    wrong = np.random.default_rng(seed).choice(len(edges), len(edges) // 3, replace=False)
    edges = with_wrong(edges, wrong, seed=seed + 50)
    # when
    found = placing.place(14, edges, *sure(edges))
    # then
    assert not found.kept[wrong].any()
    placed = found.component == 0
    assert placed.sum() >= 12
    first = int(np.flatnonzero(placed)[0])
    relative = twists.inverse(poses[first][None]) @ poses
    assert distances(found.poses[placed], relative[placed]).max() < 0.1


def test_a_wrong_loop_closure_of_a_chain_is_thrown_out():
    # given: neighbors and their neighbors, and one wrong closure from the end to the start
    poses = some_poses(8, seed=4)
    edges = graph_of(poses, noise=0.02, ahead=2)
    edges = edges.take(np.abs(edges.source - edges.target) != 6)
    last = np.flatnonzero(np.abs(edges.source - edges.target) == 7)
    edges = with_wrong(edges, last, seed=9)
    fixed = np.arange(8) == 0
    # when
    found, kept = robust.solve_robustly(edges, poses, fixed)
    # then
    np.testing.assert_array_equal(np.flatnonzero(~kept), last)
    assert distances(found, poses).max() < 0.2


def test_two_things_become_two_components_the_larger_first():
    # given
    small, large = some_poses(4, seed=1), some_poses(6, seed=2)
    edges = together(graph_of(small, noise=0.01), graph_of(large, noise=0.01, ahead=2), shift=4)
    # when
    found = placing.place(10, edges, *sure(edges))
    # then
    np.testing.assert_array_equal(found.component, [1] * 4 + [0] * 6)
    assert distances(found.poses[4:], twists.inverse(large[:1]) @ large).max() < 0.1
    assert distances(found.poses[:4], small).max() < 0.1


def test_a_single_edge_places_a_scan_only_where_it_is_sure_and_may_count_alone():
    # given: a ring, and one more scan that a single edge connects
    ring = some_poses(5, seed=3)
    edges = together(
        graph_of(ring, noise=0.01, ahead=2), graph_of(ring[:2], noise=0.01, ahead=1, ring=False), 4
    )
    values, determined = sure(edges)
    for confidence, open_, alone, placed in (
        (0.95, False, True, True),
        (0.95, False, False, False),
        (0.95, True, True, False),
        (0.6, False, True, False),
    ):
        values[-1], determined[-1] = confidence, not open_
        # when
        found = placing.place(6, edges, values, determined, alone=alone)
        # then
        assert (found.component[5] == 0) == placed, (confidence, open_, alone)


def test_a_thing_that_fits_in_two_ways_shows_in_its_edges():
    # given: a shape that a half turn hardly changes; some edges have this turn, and agree on it
    poses = some_poses(8, seed=2)
    edges = graph_of(poses, noise=0.01)
    turned = np.arange(0, len(edges), 3)
    half = np.diag([-1.0, -1.0, 1.0, 1.0])
    transform = edges.transform.copy()
    transform[turned] = transform[turned] @ half
    both = Edges(edges.source, edges.target, transform, edges.information)
    values, determined = sure(edges)
    # when
    clear, doubtful = (
        placing.share_of_others(each, found, values, determined, 1.0)[found.component]
        for each in (edges, both)
        for found in [placing.place(8, each, values, determined)]
    )
    # then
    assert clear.max() == 0
    assert doubtful.max() > placing.MOST_OTHERS


def test_two_unsure_edges_that_agree_put_two_parts_together():
    # given: two rings of one thing; two edges between them are in no cycle of three
    poses = some_poses(10, seed=6)
    rings = together(
        graph_of(poses[:5], noise=0.01, ahead=2), graph_of(poses[5:], noise=0.01, ahead=2), 5
    )
    between = Edges(
        np.array([0, 7]),
        np.array([5, 2]),
        twists.inverse(poses[[5, 2]]) @ poses[[0, 7]],
        np.stack([np.eye(6) * 1e4] * 2),
    )
    edges = together(rings, between, 0)
    values, determined = sure(edges)
    values[-2:] = 0.4
    # when
    found = placing.place(10, edges, values, determined)
    alone = placing.place(10, edges.take(np.arange(len(edges) - 1)), values[:-1], determined[:-1])
    # then
    np.testing.assert_array_equal(found.component, 0)
    assert distances(found.poses, poses).max() < 0.1
    assert alone.component.max() == 1


def test_an_unsure_edge_is_confirmed_by_a_cycle_but_not_one_that_leaves_a_motion_open():
    poses = some_poses(3, seed=8)
    edges = graph_of(poses, noise=0.01, ahead=1)
    low, yes, no = np.full(3, 0.35), np.ones(3, bool), np.zeros(3, bool)
    assert placing.place(3, edges, low, yes).kept.all()
    assert placing.place(3, edges, low, no).component.max() == 2
    broken = with_wrong(edges, np.array([1]), seed=3)
    assert placing.place(3, broken, low, yes).component.max() == 2
