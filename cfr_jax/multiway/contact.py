"""Where two scans touch: closest points, the planes there, and what they say of a motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from cfr_jax.geometry import motions
from cfr_jax.multiway.scans import Scan

# Noise that no count of points averages away, as a share of the spacing: scans are not rigid
# copies of one surface, and the points of one do not lie on those of the other.
_FLOOR = 0.25
_LEAST_SPREAD = 0.05  # of the spacing: exact copies have no residuals, and still are not certain
_AGREEING = 0.5  # cosine between two normals of one surface; their signs may differ
# What chance alone holds, in standard deviations: less than this says nothing of a direction.
_CHANCE = 4.0


@dataclass(frozen=True, eq=False)
class Contact:
    """Pairs of closest points of two scans, after a motion of the source onto the target."""

    rows: Float[np.ndarray, "k 6"]
    """How the distance to the plane changes with a twist d of the source, in the source's frame:
    the motion becomes transform @ exp(d)."""
    target_rows: Float[np.ndarray, "k 6"]
    """The same for a twist of the target, in the target's frame."""
    source_rows: Float[np.ndarray, "k 6"]
    """As `rows`, with the normals of the source's own planes."""
    heights: Float[np.ndarray, " k"]
    """Signed distances of the source's points to the planes of the target's."""
    share: float
    """How much of the source's points are among the pairs."""


def touching(
    source: Scan,
    target: Scan,
    transform: Float[np.ndarray, "4 4"],
    reach: float,
    most: int,
) -> Contact:
    """Pairs closer than `reach`, with normals that agree, of the first `most` source points."""
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

    It is that of point-to-plane least squares, with a floor under the variances. A direction that
    no plane holds (along a corridor, about an axis) is as uncertain as the scan is large. Noise in
    the normals would hide that: so each pair of points counts with the normals of both scans, whose
    noise has nothing in common, and what is left is compared with chance.
    """
    found = touching(source, target, transform, reach, most)
    spacing = max(source.spacing, target.spacing)
    count = len(found.heights)
    arm = float(np.sqrt(np.mean(np.sum(source.points[:most] ** 2, axis=1))))
    size = np.array([arm, arm, arm, 1.0, 1.0, 1.0])
    if not count:
        return np.diag((size / arm) ** 2), float("inf")
    # the median absolute deviation of normal noise, times this, is its standard deviation
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
