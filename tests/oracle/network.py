"""What CFR and RPM-Net share: layers read from a state dict, and the annealing network."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from scipy.spatial.distance import cdist

from . import pieces

Array = np.ndarray
StateDict = Mapping[str, Array]


def linear(
    state: StateDict, name: str, rows: Float[Array, "*rows i"], *, bias: bool = True
) -> Float[Array, "*rows o"]:
    """A linear layer or a 1x1 convolution: stored (out, in), (out, in, 1) or (out, in, 1, 1)."""
    weight = np.asarray(state[f"{name}.weight"], np.float64)
    product = rows @ weight.reshape(weight.shape[:2]).T
    return product + np.asarray(state[f"{name}.bias"], np.float64) if bias else product


def norm(
    state: StateDict, name: str, rows: Float[Array, "*rows c"], groups: int
) -> Float[Array, "*rows c"]:
    """Group normalization with the stored scale and shift."""
    weight = np.asarray(state[f"{name}.weight"], np.float64)
    bias = np.asarray(state[f"{name}.bias"], np.float64)
    return pieces.group_norm(rows, weight, bias, groups)


def relu(rows: Array) -> Array:
    return np.maximum(rows, 0)


def stage(
    state: StateDict, prefix: str, rows: Float[Array, "*rows i"], groups: tuple[int, ...]
) -> Float[Array, "*rows o"]:
    """Linear + GroupNorm + ReLU, once per entry of `groups`; layers are numbered 0, 3, 6, ..."""
    for layer, count in enumerate(groups):
        rows = linear(state, f"{prefix}.{3 * layer}", rows)
        rows = relu(norm(state, f"{prefix}.{3 * layer + 1}", rows, count))
    return rows


def annealing(
    state: StateDict, source: Float[Array, "n 3"], target: Float[Array, "m 3"]
) -> Float[Array, " out"]:
    """Positive annealing parameters of a pair, by a PointNet over both clouds at once.

    The fourth channel tells the clouds apart: 0 for the source, 1 for the target.
    """
    flagged = [
        np.column_stack([source, np.zeros(len(source))]),
        np.column_stack([target, np.ones(len(target))]),
    ]
    rows = stage(state, "weights_net.prepool", np.concatenate(flagged), (8, 8, 8, 8, 16))
    pooled = rows.max(axis=0)
    hidden = stage(state, "weights_net.postpool", pooled, (16, 16))
    return np.logaddexp(0, linear(state, "weights_net.postpool.6", hidden))  # softplus


def squared_distances(a: Float[Array, "n c"], b: Float[Array, "m c"]) -> Float[Array, "n m"]:
    return cdist(a, b, "sqeuclidean")


def soft_target(
    match: Float[Array, "n m"], target: Float[Array, "m 3"]
) -> tuple[Float[Array, "n 3"], Float[Array, " n"]]:
    """Where each source point is matched to, and how much of a match it has (0 to 1)."""
    weights = match.sum(axis=1)
    return (match @ target) / (weights[:, None] + 1e-5), weights
