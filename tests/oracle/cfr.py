"""CFR (Hisadome & Matsui, BMVC 2021) in float64 numpy, one loop and no cleverness.

Takes the tensors of the authors' checkpoints under their own names.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from . import pieces
from .network import StateDict, annealing, linear, norm, relu, soft_target, squared_distances, stage

Array = np.ndarray


class Trace(NamedTuple):
    """Everything on the way to the answer; the leading axis of length L is the iteration."""

    transforms: Float[Array, "L 4 4"]  # source onto target, all from the original source
    beta: Float[Array, " L"]
    alpha: Float[Array, " L"]
    source_neighbors: Int[Array, "n k"]  # after the radius rule
    target_neighbors: Int[Array, "m k"]
    source_descriptors: Float[Array, "n 96"]  # after the heavy extraction, before any iteration
    target_descriptors: Float[Array, "m 96"]
    source_features: Float[Array, "L n 96"]  # unit length, as matched
    target_features: Float[Array, "L m 96"]
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
) -> Float[Array, "L 4 4"]:
    """Transforms mapping the source `x` onto the reference `y`, one per iteration, the best last.

    `nx` and `ny` are unit normals. Needs more than `neighbors` points in each cloud and as many
    sets of iteration weights as `iterations`.
    """
    return trace(
        state_dict, x, y, nx, ny, iterations=iterations, neighbors=neighbors, radius=radius
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
    passes: int | None = None,
    anneal_again: bool = False,
    extract_again: bool = False,
) -> Trace:
    """`register`, with all intermediate results.

    The last three undo the paper's savings: so many Sinkhorn passes in every iteration; annealing
    parameters, or the heavy features of both clouds, anew in each, from the moved source.
    """
    x, y, nx, ny = (np.asarray(array, np.float64) for array in (x, y, nx, ny))

    x_neighbors = find_neighbors(x, neighbors, radius)
    y_neighbors = find_neighbors(y, neighbors, radius)
    fx = x_descriptors = extract(state_dict, raw_features(x, nx, x_neighbors))
    fy = y_descriptors = extract(state_dict, raw_features(y, ny, y_neighbors))

    parameters = annealing(state_dict, x, y)  # once, of the source where it was given
    stored = len(parameters) // 2
    if iterations > stored:
        raise ValueError(f"iterations must be at most {stored} for these weights, got {iterations}")
    beta, alpha = parameters[:iterations].copy(), parameters[stored : stored + iterations].copy()

    moved, moved_normals = x, nx
    steps = []
    for i in range(iterations):
        if anneal_again:
            parameters = annealing(state_dict, moved, y)
            beta[i], alpha[i] = parameters[i], parameters[stored + i]
        if extract_again:
            fx = extract(state_dict, raw_features(moved, moved_normals, x_neighbors))
            fy = extract(state_dict, raw_features(y, ny, y_neighbors))
        fx = refine(state_dict, i, fx, moved)
        fy = refine(state_dict, i, fy, y)
        log_affinity = -beta[i] * (squared_distances(fx, fy) - alpha[i])
        match = pieces.sinkhorn_log(log_affinity, passes=passes or i + 1)
        matched, weights = soft_target(match, y)
        transform = pieces.procrustes(x, matched, weights)  # always from the original source
        moved, moved_normals = pieces.move(transform, x), nx @ transform[:3, :3].T
        steps.append((transform, fx, fy, log_affinity, match, weights))

    transforms, x_features, y_features, log_affinities, matches, weights = (
        np.stack(column) for column in zip(*steps, strict=True)
    )
    return Trace(
        transforms,
        beta,
        alpha,
        x_neighbors,
        y_neighbors,
        x_descriptors,
        y_descriptors,
        x_features,
        y_features,
        log_affinities,
        matches,
        weights,
    )


def find_neighbors(points: Float[Array, "n 3"], k: int, radius: float) -> Int[Array, "n k"]:
    """The `k` nearest other points, those beyond `radius` replaced by the nearest."""
    return pieces.limit_to_radius(points, pieces.nearest_neighbors(points, k), radius)


def raw_features(
    points: Float[Array, "n 3"], normals: Float[Array, "n 3"], neighbors: Int[Array, "n k"]
) -> Float[Array, "n k 7"]:
    """Offset to the neighbor, then the point-pair feature; no absolute coordinate."""
    offsets = points[neighbors] - points[:, None]
    ppf = pieces.inner_product_ppf(normals, offsets, normals[neighbors])
    return np.concatenate([offsets, ppf], axis=-1)


def extract(state: StateDict, features: Float[Array, "n k 7"]) -> Float[Array, "n 96"]:
    """The heavy extraction: a network per neighbor, then the maximum; statistics over n and k."""
    return stage(state, "feat_extractor_ball.prepool", features, (8, 8, 8)).max(axis=1)


def refine(
    state: StateDict, iteration: int, features: Float[Array, "n 96"], points: Float[Array, "n 3"]
) -> Float[Array, "n 96"]:
    """One QMLP of the cascade: features mixed with current positions, out at unit length."""
    prefix = "feat_extractor_xyz"
    mixed = features + linear(state, f"{prefix}.nets_b.{iteration}.0", points, bias=False)
    hidden = relu(norm(state, f"{prefix}.nets_a.{iteration}.0", mixed, groups=8))
    out = linear(state, f"{prefix}.nets_a.{iteration}.2", hidden)
    return out / np.linalg.norm(out, axis=-1, keepdims=True)
