"""The operations of the method one by one, in float64 numpy: each the plainest form of its formula.

Nothing here is fast, batched or differentiable. Points are rows. A transform T is a 4x4 matrix
that maps the source onto the target: `T @ [x; 1]`.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.distance import cdist
from scipy.special import logsumexp

Array = np.ndarray


def group_norm(
    rows: Float[Array, "*rows c"],
    weight: Float[Array, " c"],
    bias: Float[Array, " c"],
    groups: int,
    epsilon: float = 1e-5,
) -> Float[Array, "*rows c"]:
    """Group normalization of one example whose every leading axis counts as rows.

    The mean and the (biased) variance of a group are taken over all rows and over the channels of
    that group, which are contiguous; scale and shift are per channel.
    """
    channels = rows.shape[-1]
    grouped = rows.reshape(-1, groups, channels // groups)
    mean = grouped.mean(axis=(0, 2), keepdims=True)
    variance = grouped.var(axis=(0, 2), keepdims=True)
    normalized = ((grouped - mean) / np.sqrt(variance + epsilon)).reshape(rows.shape)
    return normalized * weight + bias


def nearest_neighbors(points: Float[Array, "n 3"], k: int) -> Int[Array, "n k"]:
    """Indices of the `k` nearest other points of each point, nearest first, ties by index.

    The point itself is left out by its index, so a duplicate of it is a neighbor at distance 0.
    """
    n = len(points)
    if not 0 < k < n:
        raise ValueError(f"k must lie in 1..{n - 1} for {n} points, got {k}")
    distances = cdist(points, points)
    np.fill_diagonal(distances, np.inf)
    return np.argsort(distances, axis=1, kind="stable")[:, :k]


def limit_to_radius(
    points: Float[Array, "n 3"], neighbors: Int[Array, "n k"], radius: float
) -> Int[Array, "n k"]:
    """Neighbors beyond `radius` replaced by the nearest one (column 0), which always stays."""
    distances = np.linalg.norm(points[neighbors] - points[:, None], axis=-1)
    return np.where(distances > radius, neighbors[:, :1], neighbors)


def ball_query(
    points: Float[Array, "n 3"], radius: float, k: int, *, drop_self: bool = False
) -> Int[Array, "n k"]:
    """The first `k` points, by index and not by distance, within `radius` of each point.

    A ball that holds fewer is filled up with the point at its center. The center lies in its own
    ball unless `drop_self`. The choice is felt only where the ball holds `k` or more others:
    below that, both give the same multiset (once as a member or once more as padding).
    """
    inside = cdist(points, points) <= radius
    if drop_self:
        np.fill_diagonal(inside, False)
    indices = np.tile(np.arange(len(points))[:, None], (1, k))
    for center, members in enumerate(inside):
        first = np.flatnonzero(members)[:k]
        indices[center, : len(first)] = first
    return indices


def inner_product_ppf(
    normals: Float[Array, "n 3"],
    offsets: Float[Array, "n k 3"],
    neighbor_normals: Float[Array, "n k 3"],
) -> Float[Array, "n k 4"]:
    """Point-pair features by cosines: <n, d>/|d|, <n_k, d>/|d|, <n, n_k>, |d|."""
    own = np.broadcast_to(normals[:, None], offsets.shape)
    distance = np.linalg.norm(offsets, axis=-1)
    return np.stack(
        [
            _inner(own, offsets) / (distance + 1e-6),
            _inner(neighbor_normals, offsets) / (distance + 1e-6),
            _inner(own, neighbor_normals),
            distance,
        ],
        axis=-1,
    )


def angle_ppf(
    normals: Float[Array, "n 3"],
    offsets: Float[Array, "n k 3"],
    neighbor_normals: Float[Array, "n k 3"],
) -> Float[Array, "n k 4"]:
    """Point-pair features by angles in radians: (n, d), (n_k, d), (n, n_k), and |d|.

    The angle to a zero offset is atan2(0, 0) = 0.
    """
    own = np.broadcast_to(normals[:, None], offsets.shape)
    return np.stack(
        [
            _angle(own, offsets),
            _angle(neighbor_normals, offsets),
            _angle(own, neighbor_normals),
            np.linalg.norm(offsets, axis=-1),
        ],
        axis=-1,
    )


def pca_normals(points: Float[Array, "n 3"], neighbors: Int[Array, "n k"]) -> Float[Array, "n 3"]:
    """Unit direction of least spread of each point's neighbor set; its sign means nothing.

    The sets are taken as they are: whoever wants the point itself inside puts its index there.
    """
    sets = points[neighbors]
    centered = sets - sets.mean(axis=1, keepdims=True)
    covariance = np.einsum("nki,nkj->nij", centered, centered)
    return np.linalg.eigh(covariance)[1][..., 0]  # eigenvalues ascend


def sinkhorn_log(log_affinity: Float[Array, "n m"], passes: int) -> Float[Array, "n m"]:
    """Sinkhorn with slack in log space; returns the normalized real block, not its logarithm.

    A zero (the logarithm of one) is appended to each row and column. One pass divides every real
    row by its sum, then every real column; the slack row and column are never normalized.
    """
    n, m = log_affinity.shape
    padded = np.zeros((n + 1, m + 1))
    padded[:n, :m] = log_affinity
    for _ in range(passes):
        padded[:n] -= logsumexp(padded[:n], axis=1, keepdims=True)
        padded[:, :m] -= logsumexp(padded[:, :m], axis=0, keepdims=True)
    return np.exp(padded[:n, :m])


def sinkhorn_matrix(affinity: Float[Array, "n m"], passes: int) -> Float[Array, "n m"]:
    """The same on the affinities themselves, by literal division of rows and columns."""
    n, m = affinity.shape
    padded = np.ones((n + 1, m + 1))
    padded[:n, :m] = affinity
    for _ in range(passes):
        padded[:n] /= padded[:n].sum(axis=1, keepdims=True)
        padded[:, :m] /= padded[:, :m].sum(axis=0, keepdims=True)
    return padded[:n, :m]


def sinkhorn_scaling(affinity: Float[Array, "n m"], passes: int) -> Float[Array, "n m"]:
    """The same by a row and a column scaling: diag(u) m diag(v), with m only ever read."""
    u, v = np.ones(affinity.shape[0]), np.ones(affinity.shape[1])
    for _ in range(passes):
        u = 1 / (affinity @ v + 1)
        v = 1 / (affinity.T @ u + 1)
    return u[:, None] * affinity * v


def procrustes(
    source: Float[Array, "n 3"],
    target: Float[Array, "n 3"],
    weights: Float[Array, " n"],
    epsilon: float = 1e-5,
) -> Float[Array, "4 4"]:
    """Rigid motion carrying `source` onto `target` row by row, weighted; never a reflection.

    The weights are divided by their sum + `epsilon`, so they add up to a little less than one and
    the centroids sit a little nearer to the origin than true centroids: felt only where all the
    weights together are tiny, and kept because the published program does it.
    """
    weights = (weights / (weights.sum() + epsilon))[:, None]
    source_center = (weights * source).sum(axis=0)
    target_center = (weights * target).sum(axis=0)
    covariance = (weights * (source - source_center)).T @ (target - target_center)
    u, _, vt = np.linalg.svd(covariance)
    handedness = np.sign(np.linalg.det(vt.T @ u.T))
    rotation = vt.T @ np.diag([1.0, 1.0, handedness]) @ u.T
    return rigid(rotation, target_center - rotation @ source_center)


def rigid(rotation: Float[Array, "3 3"], translation: Float[Array, "3"]) -> Float[Array, "4 4"]:
    """The 4x4 transform x -> rotation x + translation."""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = translation
    return transform


def move(transform: Float[Array, "4 4"], points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Points after the transform."""
    return points @ transform[:3, :3].T + transform[:3, 3]


def _inner(a: Array, b: Array) -> Array:
    return (a * b).sum(axis=-1)


def _angle(a: Array, b: Array) -> Array:
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), _inner(a, b))
