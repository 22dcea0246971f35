"""Cycles of three: the motions between three scans, composed, should lead back to the start.

A wrong motion hardly ever cancels out with two others. So if a cycle closes, each of its edges is
confirmed by the other two, however uncertain each of them is alone.
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from jaxtyping import Bool, Float, Int

from cfr_jax.geometry import twists
from cfr_jax.multiway.pose_graph.graph import Edges
from cfr_jax.multiway.pose_graph.robust import LIMIT


def triangles(edges: Edges) -> Int[np.ndarray, "t 3"]:
    """All triples of edges that connect three scans. At most one edge may connect two scans."""
    beside: dict[int, dict[int, int]] = defaultdict(dict)
    for row, (a, b) in enumerate(zip(edges.source.tolist(), edges.target.tolist(), strict=True)):
        beside[a][b] = beside[b][a] = row
    found = [
        (row, beside[a][c], beside[b][c])
        for row, (a, b) in enumerate(zip(edges.source.tolist(), edges.target.tolist(), strict=True))
        for c in beside[a].keys() & beside[b].keys()
        if c > max(a, b)
    ]
    return np.array(found, np.int64).reshape(-1, 3)


def closed(edges: Edges, cycles: Int[np.ndarray, "t 3"]) -> Bool[np.ndarray, " t"]:
    """Whether each cycle leads back to the start, within the noise of its edges."""
    if not len(cycles):
        return np.zeros(0, bool)
    spread = np.linalg.inv(edges.information)
    around = np.broadcast_to(np.eye(4), (len(cycles), 4, 4))
    expected = np.zeros((len(cycles), 6, 6))
    # for the three scans a, b and c: from a to b, from b to c, and from c back to a
    a, b = edges.source[cycles[:, 0]], edges.target[cycles[:, 0]]
    ends = edges.source[cycles[:, 1]], edges.target[cycles[:, 1]]
    c = np.where(ends[0] == a, ends[1], ends[0])
    for row, start in ((cycles[:, 0], a), (cycles[:, 2], b), (cycles[:, 1], c)):
        forward = edges.source[row] == start
        motion = np.where(
            forward[:, None, None], edges.transform[row], twists.inverse(edges.transform[row])
        )
        # the noise of a backward motion is on its other side
        turned = twists.adjoint(edges.transform[row])
        noise = np.where(
            forward[:, None, None], spread[row], turned @ spread[row] @ turned.swapaxes(-1, -2)
        )
        carried = twists.adjoint(twists.inverse(around))
        expected = expected + carried @ noise @ carried.swapaxes(-1, -2)
        around = motion @ around
    off = twists.log(around)
    square = np.einsum("ti,ti->t", off, np.linalg.solve(expected, off[..., None])[..., 0])
    return square <= LIMIT


def votes(edges: Edges) -> tuple[Int[np.ndarray, " e"], Int[np.ndarray, " e"]]:
    """For each edge, the number of its cycles that close, and the number of all its cycles."""
    cycles = triangles(edges)
    good = closed(edges, cycles)
    return tuple(  # type: ignore[return-value]
        np.bincount(chosen.reshape(-1), minlength=len(edges)) for chosen in (cycles[good], cycles)
    )


def confirmed_order(
    closing: Int[np.ndarray, " e"], having: Int[np.ndarray, " e"], prior: Float[np.ndarray, " e"]
) -> Float[np.ndarray, " e"]:
    """A score of how well an edge is confirmed: mostly the share of its cycles that close, and then
    its confidence (`prior`)."""
    return closing / np.maximum(having, 1) + 0.5 * (closing > 0) + 0.1 * prior
