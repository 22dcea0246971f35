"""RGM (Fu, Liu, Luo & Wang, CVPR 2021) in float64 numpy.

Takes the tensors of the authors' checkpoints under their own names, batch norm by running
statistics.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist
from scipy.special import logsumexp

from . import pieces
from .dcp import edge_features, linear, softmax, transformer

Array = np.ndarray
StateDict = Mapping[str, Array]


def soft_assignment(
    state: StateDict,
    x: Float[Array, "n 3"],
    y: Float[Array, "m 3"],
    *,
    neighbors: int = 20,
    slack: bool = True,
) -> Float[Array, "n m"]:
    """The soft assignment of the second layer; `neighbors` count the point itself."""
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    f, g = (
        np.concatenate(edge_features(state, "pointfeaturer", cloud, neighbors), axis=1)
        for cloud in (x, y)
    )
    for i in range(2):
        attend = f"gmattend{i}.model"
        seen = transformer(state, attend, f, g), transformer(state, attend, g, f)
        f, g = (
            convolution(state, f"gnn_layer_{i}.gconv", e, rows)
            for e, rows in zip(seen, (f, g), strict=True)
        )
        matrix = np.asarray(state[f"affinity_{i}.A"], np.float64)
        values = f @ ((matrix + matrix.T) / 2) @ g.T
        values = (values - values.mean()) / np.sqrt(values.var() + 1e-5)
        weight, bias = (
            float(state[f"InstNorm_layer_{i}.{name}"][0]) for name in ("weight", "bias")
        )
        values = weight * values + bias
        found = pieces.sinkhorn_log(values, 20) if slack else sinkhorn_without_slack(values, 20)
        if i == 0:
            f, g = (
                linear(state, "cross_graph_0", np.concatenate(pair, axis=1))
                for pair in ((f, found @ g), (g, found.T @ f))
            )
    return found


def convolution(
    state: StateDict, prefix: str, e: Float[Array, "n i"], rows: Float[Array, "n i"]
) -> Float[Array, "n w"]:
    """Features mixed along the edges that the softmax of e gives, its columns divided by their sums
    afterwards."""
    ties = softmax(e @ e.T / np.sqrt(e.shape[1]))
    ties = ties / ties.sum(axis=0, keepdims=True)
    along, own = (
        np.maximum(linear(state, f"{prefix}.{name}", rows), 0) for name in ("a_fc", "u_fc")
    )
    return ties @ along + own


def sinkhorn_without_slack(log_values: Float[Array, "n m"], passes: int) -> Float[Array, "n m"]:
    for _ in range(passes):
        log_values = log_values - logsumexp(log_values, axis=1, keepdims=True)
        log_values = log_values - logsumexp(log_values, axis=0, keepdims=True)
    return np.exp(log_values)


def assigned(soft: Float[Array, "n m"], least: float) -> Float[Array, "n m"]:
    """The one-to-one assignment of a soft one, of what is found more than `least` of."""
    rows, columns = np.nonzero(soft.sum(1) > least)[0], np.nonzero(soft.sum(0) > least)[0]
    hard = np.zeros_like(soft)
    for i, j in zip(*linear_sum_assignment(-soft[rows][:, columns]), strict=True):
        hard[rows[i], columns[j]] = 1
    return hard


def register(
    state: StateDict, x: Float[Array, "n 3"], y: Float[Array, "m 3"], *, neighbors: int = 20
) -> Float[Array, "4 4"]:
    """The motion of `x` onto `y`: two rounds each way, and the pairs that both ways found."""
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    hard = []
    for own, other in ((x, y), (y, x)):
        first = assigned(soft_assignment(state, own, other, neighbors=neighbors), 0.5)
        moved = pieces.move(motion(own, other, first), own)
        hard.append(assigned(soft_assignment(state, moved, other, neighbors=neighbors), 0.5))
    return motion(x, y, hard[0] * hard[1].T)


def motion(
    x: Float[Array, "n 3"], y: Float[Array, "m 3"], hard: Float[Array, "n m"]
) -> Float[Array, "4 4"]:
    return pieces.procrustes(x, hard @ y, hard.sum(axis=1))


def true_assignment(moved: Float[Array, "n 3"], target: Float[Array, "m 3"]) -> Float[Array, "n m"]:
    """The labels, point after point, of a source that lies where it belongs."""
    distance = cdist(moved, target)
    n, m = distance.shape
    partner: dict[int, int] = {}
    taken: set[int] = set()
    of_rows, of_columns = distance.argmin(axis=1), distance.argmin(axis=0)
    for i in range(n):
        j = of_rows[i]
        if of_columns[j] == i and distance[i, j] < 0.05:
            partner[i] = j
            taken.add(j)
    # the closest first, so that it has what several ask for
    asking = sorted((distance[i, of_rows[i]], i, of_rows[i]) for i in range(n))
    _pair_up(asking, partner, taken)
    asking = sorted((distance[of_columns[j], j], of_columns[j], j) for j in range(m))
    _pair_up(asking, partner, taken)
    rows = [i for i in range(n) if i not in partner]
    columns = [j for j in range(m) if j not in taken]
    left = distance[np.ix_(rows, columns)]
    found = np.zeros((n, m))
    if left.size:
        for a, i in enumerate(rows):
            b = left[a].argmin()
            if left[:, b].argmin() == a and left[a, b] < 0.1:
                found[i, columns[b]] = 1
    for i, j in partner.items():
        found[i, j] = 1
    return found


def _pair_up(asking: list, partner: dict[int, int], taken: set[int]) -> None:
    """Those asking that are free, and whose wish is, and that lie close."""
    for distance, i, j in asking:
        if distance < 0.05 and i not in partner and j not in taken:
            partner[i] = j
            taken.add(j)
