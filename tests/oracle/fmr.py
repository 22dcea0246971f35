"""FMR (Huang, Mei & Zhang, CVPR 2020) in float64 numpy: encoder, decoder, and the registration.

Takes the tensors of the authors' checkpoints under their own names, batch norm by running
statistics. Template is the target, and the motion maps source onto target.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from scipy.linalg import expm
from scipy.spatial.distance import cdist

from . import pieces
from .dcp import convolved, linear

Array = np.ndarray
StateDict = Mapping[str, Array]


def encode(state: StateDict, points: Float[Array, "n 3"]) -> Float[Array, "1024"]:
    """The vector of a cloud."""
    rows = points
    for conv, norm in (("h1.0", "h1.1"), ("h1.3", "h1.4")):
        rows = convolved(state, f"encoder.{conv}", f"encoder.{norm}", rows)
    for conv, norm in (("h2.0", "h2.1"), ("h2.3", "h2.4"), ("h2.6", "h2.7")):
        rows = convolved(state, f"encoder.{conv}", f"encoder.{norm}", rows)
    return rows.max(axis=0)


def decode(state: StateDict, vector: Float[Array, "1024"]) -> Float[Array, "2048 3"]:
    """Points of a vector."""
    for i in (1, 2, 3):
        vector = convolved(state, f"decoder.fc{i}", f"decoder.bn{i}", vector)
    return np.tanh(linear(state, "decoder.fc4", vector)).reshape(3, 2048).T


def motion(twist: Float[Array, "6"]) -> Float[Array, "4 4"]:
    """The exponential of a twist, rotation first, by the matrix exponential."""
    a, b, c = twist[:3]
    generator = np.zeros((4, 4))
    generator[:3, :3] = [[0, -c, b], [c, 0, -a], [-b, a, 0]]
    generator[:3, 3] = twist[3:]
    return expm(generator)


def jacobian(state: StateDict, points: Float[Array, "n 3"]) -> Float[Array, "1024 6"]:
    """Backward differences along the six twists, with the steps of the checkpoint."""
    steps = np.asarray(state["dt"], np.float64).ravel()
    at = encode(state, points)
    columns = []
    for k, step in enumerate(steps):
        moved = pieces.move(motion(-step * np.eye(6)[k]), points)
        columns.append((at - encode(state, moved)) / step)
    return np.stack(columns, axis=1)


def register(
    state: StateDict, x: Float[Array, "n 3"], y: Float[Array, "m 3"], iterations: int = 10
) -> Float[Array, "L 4 4"]:
    """The motion of `x` onto `y` after each iteration."""
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    here, there = x.mean(axis=0), y.mean(axis=0)
    wanted, slope = encode(state, y - there), jacobian(state, y - there)
    inverse = np.linalg.inv(slope.T @ slope) @ slope.T
    found, every = np.eye(4), []
    for _ in range(iterations):
        residual = encode(state, pieces.move(found, x - here)) - wanted
        step = -inverse @ residual
        if np.abs(step).max() >= 1e-7:
            found = motion(step) @ found
        every.append(pieces.rigid(np.eye(3), there) @ found @ pieces.rigid(np.eye(3), -here))
    return np.stack(every)


def remade(state: StateDict, points: Float[Array, "n 3"]) -> float:
    """The Chamfer distance of a centered cloud and what the decoder makes of it."""
    square = cdist(points, decode(state, encode(state, points)), "sqeuclidean")
    return float(square.min(axis=1).mean() + square.min(axis=0).mean())
