"""DCP (Wang & Solomon, ICCV 2019) in float64 numpy, v1 and v2, and what RGM shares with it.

Takes the tensors of the authors' checkpoints under their own names, batch norm by running
statistics.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from scipy.spatial.distance import cdist

from . import pieces

Array = np.ndarray
StateDict = Mapping[str, Array]


def register(
    state: StateDict, x: Float[Array, "n 3"], y: Float[Array, "m 3"], neighbors: int = 20
) -> Float[Array, "4 4"]:
    """The motion of `x` onto `y`; `neighbors` count the point itself."""
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    f, g = matched_features(state, x, y, neighbors)
    match = softmax(f @ g.T / np.sqrt(f.shape[1]))
    targets = match @ y
    covariance = (x - x.mean(axis=0)).T @ (targets - targets.mean(axis=0))
    u, _, vt = np.linalg.svd(covariance)
    v = vt.T
    if np.linalg.det(v @ u.T) < 0:
        v = v @ np.diag([1.0, 1.0, -1.0])
    rotation = v @ u.T
    return pieces.rigid(rotation, targets.mean(axis=0) - rotation @ x.mean(axis=0))


def matched_features(
    state: StateDict, x: Float[Array, "n 3"], y: Float[Array, "m 3"], neighbors: int
) -> tuple[Float[Array, "n w"], Float[Array, "m w"]]:
    """The features of both clouds as they are matched."""
    f, g = (edge_features(state, "emb_nn", cloud, neighbors)[1] for cloud in (x, y))
    if not any(name.startswith("pointer.") for name in state):
        return f + f, g + g
    pointed = (
        transformer(state, "pointer.model", query, memory) for query, memory in ((f, g), (g, f))
    )
    return tuple(own + more for own, more in zip((f, g), pointed, strict=True))


def edge_features(
    state: StateDict, prefix: str, points: Float[Array, "n 3"], neighbors: int
) -> tuple[Float[Array, "n w"], Float[Array, "n w"]]:
    """What the edges pool to after each of four layers, joined; and a fifth layer of that."""
    order = np.argsort(cdist(points, points), axis=1, kind="stable")[:, :neighbors]
    centers = np.repeat(points[:, None], neighbors, axis=1)
    rows = np.concatenate([points[order], centers], axis=2)
    pooled = []
    for i in range(1, 5):
        rows = convolved(state, f"{prefix}.conv{i}", f"{prefix}.bn{i}", rows)
        pooled.append(rows.max(axis=1))
    node = np.concatenate(pooled, axis=1)
    return node, convolved(state, f"{prefix}.conv5", f"{prefix}.bn5", node)


def convolved(
    state: StateDict, conv: str, norm: str, rows: Float[Array, "*rows i"]
) -> Float[Array, "*rows o"]:
    """A 1x1 convolution or a linear layer, with its bias where it has one, batch norm, ReLU."""
    out = linear(state, conv, rows)
    mean, variance, scale, shift = (
        np.asarray(state[f"{norm}.{name}"], np.float64)
        for name in ("running_mean", "running_var", "weight", "bias")
    )
    return np.maximum((out - mean) / np.sqrt(variance + 1e-5) * scale + shift, 0)


def linear(state: StateDict, name: str, rows: Float[Array, "*rows i"]) -> Float[Array, "*rows o"]:
    """A linear layer, or a convolution stored with further axes of one."""
    weight = np.asarray(state[f"{name}.weight"], np.float64)
    out = rows @ weight.reshape(weight.shape[:2]).T
    bias = state.get(f"{name}.bias")
    return out if bias is None else out + np.asarray(bias, np.float64)


def transformer(
    state: StateDict, prefix: str, query: Float[Array, "n w"], memory: Float[Array, "m w"]
) -> Float[Array, "n w"]:
    """What the decoder makes of the query cloud, with the memory cloud encoded."""
    block = f"{prefix}.encoder.layers.0"
    normed = point_norm(state, f"{block}.sublayer.0.norm", memory)
    memory = memory + attention(state, f"{block}.self_attn", normed, normed)
    normed = point_norm(state, f"{block}.sublayer.1.norm", memory)
    memory = memory + feed_forward(state, f"{block}.feed_forward", normed)
    memory = point_norm(state, f"{prefix}.encoder.norm", memory)

    block = f"{prefix}.decoder.layers.0"
    normed = point_norm(state, f"{block}.sublayer.0.norm", query)
    query = query + attention(state, f"{block}.self_attn", normed, normed)
    normed = point_norm(state, f"{block}.sublayer.1.norm", query)
    query = query + attention(state, f"{block}.src_attn", normed, memory)
    normed = point_norm(state, f"{block}.sublayer.2.norm", query)
    query = query + feed_forward(state, f"{block}.feed_forward", normed)
    return point_norm(state, f"{prefix}.decoder.norm", query)


def attention(
    state: StateDict,
    prefix: str,
    query: Float[Array, "n w"],
    memory: Float[Array, "m w"],
    heads: int = 4,
) -> Float[Array, "n w"]:
    """Head by head: a head owns consecutive channels."""
    q, k, v = (
        linear(state, f"{prefix}.linears.{i}", rows)
        for i, rows in enumerate((query, memory, memory))
    )
    size = q.shape[1] // heads
    out = []
    for head in range(heads):
        own = slice(head * size, (head + 1) * size)
        out.append(softmax(q[:, own] @ k[:, own].T / np.sqrt(size)) @ v[:, own])
    return linear(state, f"{prefix}.linears.3", np.concatenate(out, axis=1))


def feed_forward(state: StateDict, prefix: str, rows: Float[Array, "n w"]) -> Float[Array, "n w"]:
    return linear(state, f"{prefix}.w_2", np.maximum(linear(state, f"{prefix}.w_1", rows), 0))


def point_norm(state: StateDict, name: str, rows: Float[Array, "n w"]) -> Float[Array, "n w"]:
    """The unbiased standard deviation, epsilon outside of the root."""
    scale, shift = (np.asarray(state[f"{name}.{part}"], np.float64) for part in ("a_2", "b_2"))
    deviation = rows.std(axis=1, ddof=1, keepdims=True)
    return scale * (rows - rows.mean(axis=1, keepdims=True)) / (deviation + 1e-6) + shift


def softmax(scores: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """Of each row."""
    raised = np.exp(scores - scores.max(axis=1, keepdims=True))
    return raised / raised.sum(axis=1, keepdims=True)
