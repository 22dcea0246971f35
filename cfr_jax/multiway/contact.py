"""Contact of two scans: their closest points, the planes there, and the information they give."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from cfr_jax.geometry import motions
from cfr_jax.multiway.scans import Scan

# Noise that does not average away however many points there are, as a share of the spacing. Scans
# are not rigid copies of one surface, and the points of one do not lie on those of the other.
_FLOOR = 0.25
_LEAST_SPREAD = 0.05  # share of the spacing: even exact copies, without residuals, are not certain
_AGREEING = 0.5  # least cosine between two normals of one surface; their signs may differ
# A direction is determined only by information of more than this many standard deviations of what
# noise in the normals makes by chance.
_CHANCE = 4.0


@dataclass(frozen=True, eq=False)
class Contact:
    """Pairs of closest points of two scans, after a motion of the source onto the target."""

    rows: Float[np.ndarray, "k 6"]
    """The derivative of each distance to the plane by a twist d of the source, in the source's
    frame. The twist makes the motion transform @ exp(d)."""
    target_rows: Float[np.ndarray, "k 6"]
    """The same derivative by a twist of the target, in the target's frame."""
    source_rows: Float[np.ndarray, "k 6"]
    """Like `rows`, but with the source's own normals."""
    heights: Float[np.ndarray, " k"]
    """The signed distances from the source's points to the planes at their target points."""
    share: float
    """The share of the source's points that are in a pair."""


def touching(
    source: Scan,
    target: Scan,
    transform: Float[np.ndarray, "4 4"],
    reach: float,
    most: int,
) -> Contact:
    """The pairs closer than `reach` whose normals agree, among the first `most` source points."""
    points, normals = source.points[:most], source.normals[:most]
    moved = motions.apply(transform, points)
    distance, index = target.tree.query(moved, distance_upper_bound=reach)
    near = np.flatnonzero(np.isfinite(distance))
    planes = target.normals[index[near]]
    along = np.einsum("ij,ij->i", motions.rotate(transform, normals[near]), planes)
    agreeing = np.abs(along) >= _AGREEING
    near, planes, along = near[agreeing], planes[agreeing], along[agreeing]
    own = np.sign(along)[:, None] * normals[near]
    moved, partners = moved[near], target.points[index[near]]
    inside = planes @ transform[:3, :3]  # the planes' normals in the source's frame
    return Contact(
        np.concatenate([np.cross(points[near], inside), inside], axis=1),
        -np.concatenate([np.cross(moved, planes), planes], axis=1),
        np.concatenate([np.cross(points[near], own), own], axis=1),
        np.einsum("ij,ij->i", moved - partners, planes),
        len(near) / max(len(points), 1),
    )


def information(
    source: Scan, target: Scan, transform: Float[np.ndarray, "4 4"], reach: float, most: int = 2000
) -> tuple[Float[np.ndarray, "6 6"], float]:
    """The information matrix of a motion (see `graph.Edges`), and the RMS distance to the planes.

    It is the matrix of point-to-plane least squares, with a lower bound on the variances. If no
    plane constrains a direction (along a corridor, about an axis), the uncertainty in it is the
    size of the scan. Noise in the normals would hide this. So each pair of points uses the normals
    of both scans, whose noise is independent, and the result is compared with what chance makes.
    """
    found = touching(source, target, transform, reach, most)
    spacing = max(source.spacing, target.spacing)
    count = len(found.heights)
    arm = float(np.sqrt(np.mean(np.sum(source.points[:most] ** 2, axis=1))))
    size = np.array([arm, arm, arm, 1.0, 1.0, 1.0])
    if not count:
        return np.diag((size / arm) ** 2), float("inf")
    # 1.4826 times the median absolute deviation of Gaussian noise is its standard deviation
    spread = 1.4826 * float(np.median(np.abs(found.heights)))
    spread = max(spread, _LEAST_SPREAD * spacing)
    first, second = found.rows / size, found.source_rows / size
    held = (first.T @ second + second.T @ first) / 2
    chance = _CHANCE * float(np.mean((first - second) ** 2)) / 2 * np.sqrt(count)
    values, directions = np.linalg.eigh(held)
    variance = np.where(values > chance, spread**2 / np.maximum(values, 1e-12), arm**2)
    covariance = (directions * variance) @ directions.T + (_FLOOR * spacing) ** 2 * np.eye(6)
    covariance = covariance / np.outer(size, size)
    return np.linalg.inv(covariance), float(np.sqrt(np.mean(found.heights**2)))
