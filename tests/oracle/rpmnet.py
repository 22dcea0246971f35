"""RPM-Net (Yew & Lee, CVPR 2020) in float64 numpy, as published; the baseline of CFR.

Takes the tensors of the authors' checkpoints under their own names. Where the description used
leaves room, the reading taken here is:

- the ten channels are the center's own absolute position (not the neighbor's), the offset to the
  neighbor, the point-pair feature by angles, in this order, and all of them follow the source as
  it moves;
- a point at exactly the radius is inside the ball;
- the center is a member of its own ball (see `pieces.ball_query` for where that matters);
- the two outputs of the annealing network are beta, then alpha, after softplus;
- GroupNorm after the pooling takes its statistics over all points of one cloud;
- the loop carries the moved normals, too, and they are always moved from the original ones;
- the Procrustes runs from the original source, as in CFR.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from . import pieces
from .network import StateDict, annealing, linear, soft_target, squared_distances, stage

Array = np.ndarray

SINKHORN_PASSES = 5


class Trace(NamedTuple):
    """Everything on the way to the answer; the leading axis of length L is the iteration."""

    transforms: Float[Array, "L 4 4"]  # source onto target, all from the original source
    beta: Float[Array, " L"]
    alpha: Float[Array, " L"]
    source_features: Float[Array, "L n 96"]  # unit length, as matched
    target_features: Float[Array, "m 96"]  # the reference never moves: the same every time
    log_affinities: Float[Array, "L n m"]  # -beta (squared feature distance - alpha)
    matches: Float[Array, "L n m"]  # after Sinkhorn, real block
    weights: Float[Array, "L n"]  # row sums of the matches


def register(
    state_dict: StateDict,
    x: Float[Array, "n 3"],
    y: Float[Array, "m 3"],
    nx: Float[Array, "n 3"],
    ny: Float[Array, "m 3"],
    *,
    iterations: int = 5,
    neighbors: int = 64,
    radius: float = 0.3,
    drop_self: bool = False,
) -> Float[Array, "L 4 4"]:
    """Transforms mapping the source `x` onto the reference `y`, one per iteration, the best last.

    `nx` and `ny` are unit normals. The same weights serve any number of iterations.
    """
    return trace(
        state_dict,
        x,
        y,
        nx,
        ny,
        iterations=iterations,
        neighbors=neighbors,
        radius=radius,
        drop_self=drop_self,
    ).transforms


def trace(
    state_dict: StateDict,
    x: Float[Array, "n 3"],
    y: Float[Array, "m 3"],
    nx: Float[Array, "n 3"],
    ny: Float[Array, "m 3"],
    *,
    iterations: int = 5,
    neighbors: int = 64,
    radius: float = 0.3,
    drop_self: bool = False,
) -> Trace:
    """`register`, with all intermediate results."""
    x, y, nx, ny = (np.asarray(array, np.float64) for array in (x, y, nx, ny))

    def describe(points: Array, normals: Array) -> Array:
        ball = pieces.ball_query(points, radius, neighbors, drop_self=drop_self)
        return extract(state_dict, raw_features(points, normals, ball))

    fy = describe(y, ny)
    moved, moved_normals = x, nx
    steps = []
    for _ in range(iterations):
        beta, alpha = annealing(state_dict, moved, y)
        fx = describe(moved, moved_normals)
        log_affinity = -beta * (squared_distances(fx, fy) - alpha)
        match = pieces.sinkhorn_log(log_affinity, SINKHORN_PASSES)
        matched, weights = soft_target(match, y)
        transform = pieces.procrustes(x, matched, weights)
        moved = pieces.move(transform, x)
        moved_normals = nx @ transform[:3, :3].T
        steps.append((transform, beta, alpha, fx, log_affinity, match, weights))

    transforms, betas, alphas, x_features, log_affinities, matches, weights = (
        np.stack(column) for column in zip(*steps, strict=True)
    )
    return Trace(transforms, betas, alphas, x_features, fy, log_affinities, matches, weights)


def raw_features(
    points: Float[Array, "n 3"], normals: Float[Array, "n 3"], neighbors: Array
) -> Float[Array, "n k 10"]:
    """Position of the center, offset to the neighbor, then the point-pair feature by angles."""
    offsets = points[neighbors] - points[:, None]
    position = np.broadcast_to(points[:, None], offsets.shape)
    ppf = pieces.angle_ppf(normals, offsets, normals[neighbors])
    return np.concatenate([position, offsets, ppf], axis=-1)


def extract(state: StateDict, features: Float[Array, "n k 10"]) -> Float[Array, "n 96"]:
    """A network per neighbor, the maximum over neighbors, a network per point; unit length."""
    pooled = stage(state, "feat_extractor.prepool", features, (8, 8, 8)).max(axis=1)
    hidden = stage(state, "feat_extractor.postpool", pooled, (8, 8))
    out = linear(state, "feat_extractor.postpool.6", hidden)
    return out / np.linalg.norm(out, axis=-1, keepdims=True)
