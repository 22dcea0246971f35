"""From edges to poses: which edges to rely on, which scans belong together, and where each lies.

Only motions that the scans determine count. An edge is relied on only if a cycle of three confirms
it. Its own confidence is not enough, because a nearly symmetric thing fits in more than one way.
The parts of a model that are found in this way are joined if two edges between them agree. Parts
that are still not connected stay separate.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse import csgraph

from cfr_jax.geometry import twists
from cfr_jax.multiway.pose_graph import cycles, graph, robust
from cfr_jax.multiway.pose_graph.graph import Edges
from cfr_jax.multiway.pose_graph.robust import LIMIT

SURE = 0.9  # edges of this confidence need no confirmation, if there can be none
TRUSTED = 0.5
# An edge that differs from the poses by more than this is a different answer, and not only noisy.
_FAR_TURN, _FAR_PLACE = np.radians(15.0), 0.15  # the second is a share of the radius
# The largest share of trusted edges, weighted by confidence, that may be different answers. Of 40
# shapes seen from 12 sides (`tools/make_views.py`), those whose scans were placed right had at most
# 10 %. Those that fit in several ways and were placed wrong had 14 % or more, except for a mug, a
# creamer and a cooker.
MOST_OTHERS = 0.12
POSSIBLE = 0.3  # edges of less confidence are ignored


@dataclass(frozen=True, eq=False)
class Placement:
    """Poses and edges that agree with each other."""

    poses: Float[np.ndarray, "n 4 4"]
    """The pose of each scan, in the frame of the first scan of its component."""
    component: Int[np.ndarray, " n"]
    """The component of each scan. The largest is 0; a single scan is a component, too."""
    kept: Bool[np.ndarray, " e"]
    """Whether the poses agree with each edge."""
    strong: Bool[np.ndarray, " e"]
    """Whether each edge was good enough to be relied on (`build_on`)."""


def place(
    count: int,
    edges: Edges,
    confidence: Float[np.ndarray, " e"],
    determined: Bool[np.ndarray, " e"],
    *,
    alone: bool = False,
) -> Placement:
    """Finds poses for `count` scans. At most one edge may connect two scans.

    With `alone`, an edge of high confidence needs no cycle. Use this if the order of the scans says
    that the edge should exist, or if there are only two scans.
    """
    strong = build_on(edges, confidence, determined, alone=alone)
    closing, having = cycles.votes(edges)
    order = cycles.confirmed_order(closing, having, confidence)
    held, rejected = strong.copy(), np.zeros(len(edges), bool)
    while True:
        labels = _components(count, edges.take(held))
        fixed = first_of_each(labels)
        poses = _along_tree(count, edges.take(held), order[held], fixed)
        poses, agreeing = robust.solve_robustly(
            edges.take(held), poses, fixed, prior=confidence[held]
        )
        if not agreeing.all():
            # this may disconnect parts of the graph; each part is then solved separately
            rejected[np.flatnonzero(held)[~agreeing]] = True
            held &= ~rejected
            continue
        open_ = determined & ~held & ~rejected & (confidence >= POSSIBLE)
        more = agreeing_between(edges, poses, labels, open_)
        if not more.any():
            break
        held |= more
    within = labels[edges.source] == labels[edges.target]
    # edges that were too weak to rely on may still agree with the poses
    off = graph.chi_squares(edges, poses)
    kept = held | (within & (confidence >= POSSIBLE) & (off <= LIMIT))
    return Placement(poses, labels, kept, strong)


def build_on(
    edges: Edges,
    confidence: Float[np.ndarray, " e"],
    determined: Bool[np.ndarray, " e"],
    *,
    alone: bool,
) -> Bool[np.ndarray, " e"]:
    """Whether each edge is good enough to rely on when scans are placed.

    A sure edge that counts `alone` must not be in a cycle of sure edges that does not close.
    """
    # an edge that slides or turns freely closes cycles by chance, as it stays about where it lay
    possible = determined & (confidence >= POSSIBLE)
    strong = np.zeros(len(edges), bool)
    rows = np.flatnonzero(possible)
    found = cycles.triangles(edges.take(rows))
    good = cycles.closed(edges.take(rows), found)
    strong[rows[np.unique(found[good])]] = True
    if not alone:
        return strong
    sure = determined & (confidence >= SURE)
    against = ~good & sure[rows[found]].all(axis=1)
    doubted = np.zeros(len(edges), bool)
    doubted[rows[np.unique(found[against])]] = True
    return strong | (sure & ~doubted)


def share_of_others(
    edges: Edges,
    placement: Placement,
    confidence: Float[np.ndarray, " e"],
    determined: Bool[np.ndarray, " e"],
    radius: float,
) -> Float[np.ndarray, " c"]:
    """For each component, the share of its trusted edges, weighted by confidence, that contradict
    the poses.

    Scans of a nearly symmetric thing fit together in several ways, and many edges support each of
    these ways. Then nothing says which one is right.
    """
    labels = placement.component
    off = graph.residuals(edges, placement.poses)
    far = np.linalg.norm(off[:, :3], axis=1) > _FAR_TURN
    far |= np.linalg.norm(off[:, 3:], axis=1) > _FAR_PLACE * radius
    within = labels[edges.source] == labels[edges.target]
    weight = confidence * (within & determined & (confidence >= TRUSTED))
    count = labels.max() + 1
    total = np.bincount(labels[edges.source], weight, count)
    other = np.bincount(labels[edges.source], weight * far, count)
    return other / np.maximum(total, 1e-12)


def agreeing_between(
    edges: Edges,
    poses: Float[np.ndarray, "n 4 4"],
    labels: Int[np.ndarray, " n"],
    among: Bool[np.ndarray, " e"],
) -> Bool[np.ndarray, " e"]:
    """Marks edges between two components if at least two of them join the components in the same
    way."""
    rows = np.flatnonzero(among & (labels[edges.source] != labels[edges.target]))
    chosen = np.zeros(len(edges), bool)
    parts = np.sort(np.stack([labels[edges.source], labels[edges.target]], axis=1), axis=1)
    for pair in np.unique(parts[rows], axis=0):
        here = rows[(parts[rows] == pair).all(axis=1)]
        best = max(
            (here[_agreeing(edges, poses, labels, row, here)] for row in here.tolist()), key=len
        )
        if len(best) > 1:
            chosen[best] = True
    return chosen


def _agreeing(
    edges: Edges,
    poses: Float[np.ndarray, "n 4 4"],
    labels: Int[np.ndarray, " n"],
    row: int,
    others: Int[np.ndarray, " k"],
) -> Bool[np.ndarray, " k"]:
    """Which of the `others` agree with the edge in `row` after that edge has joined the
    components."""
    source, target = edges.source[row], edges.target[row]
    laid = poses[target] @ edges.transform[row] @ twists.inverse(poses[source])
    moved = np.where((labels == labels[source])[:, None, None], laid @ poses, poses)
    taken = edges.take(others)
    off = graph.residuals(taken, moved)
    # the joining edge is noisy itself, and its noise moves distant scans farther
    carried = twists.adjoint(twists.inverse(moved[taken.source]) @ moved[source])
    noise = carried @ np.linalg.inv(edges.information[row]) @ carried.swapaxes(-1, -2)
    spread = np.linalg.inv(taken.information) + noise
    return np.einsum("ei,ei->e", off, np.linalg.solve(spread, off[..., None])[..., 0]) <= LIMIT


def first_of_each(labels: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Marks the first scan of each component."""
    first = np.zeros(len(labels), bool)
    first[np.unique(labels, return_index=True)[1]] = True
    return first


def _components(count: int, edges: Edges) -> Int[np.ndarray, " n"]:
    """The number of each scan's component. Larger components come first; equal ones keep their
    order."""
    links = sparse.coo_matrix(
        (np.ones(len(edges)), (edges.source, edges.target)), shape=(count, count)
    )
    _, labels = csgraph.connected_components(links, directed=False)
    _, first, sizes = np.unique(labels, return_index=True, return_counts=True)
    rank = np.empty(len(sizes), np.int64)
    rank[np.lexsort((first, -sizes))] = np.arange(len(sizes))
    return rank[labels]


def _along_tree(
    count: int, edges: Edges, order: Float[np.ndarray, " e"], fixed: Bool[np.ndarray, " n"]
) -> Float[np.ndarray, "n 4 4"]:
    """Initial poses: starts at the fixed scans and always follows the best edge to a new scan."""
    poses = np.broadcast_to(np.eye(4), (count, 4, 4)).copy()
    known = fixed.copy()
    for row in _tree(count, edges, order, fixed):
        source, target = edges.source[row], edges.target[row]
        if known[target]:
            poses[source] = poses[target] @ edges.transform[row]
            known[source] = True
        else:
            poses[target] = poses[source] @ twists.inverse(edges.transform[row])
            known[target] = True
    return poses


def _tree(
    count: int, edges: Edges, order: Float[np.ndarray, " e"], fixed: Bool[np.ndarray, " n"]
) -> list[int]:
    """The rows of a spanning forest of the best edges, in the order of Prim's algorithm: each edge
    touches a scan that is already known."""
    beside: list[list[int]] = [[] for _ in range(count)]
    for row, ends in enumerate(zip(edges.source.tolist(), edges.target.tolist(), strict=True)):
        for scan in ends:
            beside[scan].append(row)
    known, chosen = fixed.copy(), []
    waiting = [(-order[row], row) for scan in np.flatnonzero(fixed) for row in beside[scan]]
    heapq.heapify(waiting)
    while waiting:
        _, row = heapq.heappop(waiting)
        ends = edges.source[row], edges.target[row]
        new = [scan for scan in ends if not known[scan]]
        if not new:
            continue
        known[new] = True
        chosen.append(row)
        for other in beside[new[0]]:
            heapq.heappush(waiting, (-order[other], other))
    return chosen
