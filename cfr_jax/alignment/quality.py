"""Measures, without the truth, how good a registration is and whether the clouds determine it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from cfr_jax.geometry import rigid
from cfr_jax.geometry.closest import closest
from cfr_jax.refine.generalized_icp import squared_distances
from cfr_jax.refine.surfaces import Surface

_HIGHEST = lax.Precision.HIGHEST
_NUDGE = 0.15  # radians and units of the unit sphere; three times the usual inlier distance
_TEXTURE = 0.06  # nudges this small depend on the sampling: on where points lie on the surface
_LEAST = 0.2  # if less of the fit than this is left to lose, a rise may be chance
_POINTWISE = 1e-3  # share of point-to-point information, for directions that no normal resists
_WEAKEST = 3  # a plane slides along two axes and turns about one; a ball turns about three


@struct.dataclass
class Quality:
    """The quality of an answer, measured in the unit sphere under the answer's transform."""

    fitness: Float[Array, ""]
    """The share of source points with a target point within the inlier distance."""
    inlier_rmse: Float[Array, ""]
    """The root mean square distance from those points to the target; 0 if there are none."""
    resistance: Float[Array, " w"]
    """How much the fit suffers from a nudge along each of the weakest directions. About 0 means not
    at all (the clouds slide or turn freely); 1 means that the whole fit is lost."""
    weakest: Float[Array, "w 6"]
    """The weakest directions: twists in the target's frame, rotation first, of unit length."""
    overlap: Float[Array, ""]
    """The estimated share of the source that the target shows, too."""
    moments: Float[Array, "4 4"]
    """The sum of [y; 1][y; 1]' over the target points that lie closest to the inliers."""


def measure(
    source: Surface,
    target: Surface,
    transform: Float[Array, "4 4"],
    distance: float,
    spacing: Float[Array, ""],
) -> Quality:
    """Measures fitness, inlier error, overlap and resistance of `transform` (source onto target).

    The overlap counts the points of the source with a target point closer than twice the target's
    `spacing`. On 78 partial, noisy validation pairs under the truth, this was off the true overlap
    by 0.02 on average, and at most 0.006 too high.

    The weakest directions are the eigenvectors with the smallest eigenvalues of the point-to-plane
    information matrix (geometric stability: Gelfand et al., 2003). A little point-to-point
    information is added to this matrix. So among the directions that no normal resists, those that
    move the points least come first (a line turns about itself before it slides).

    Noise in the normals keeps the eigenvalue of a free direction from being small, so each
    direction is also tried: the source is nudged both ways along it, and the rise of the truncated
    score is compared with the largest rise possible. The rise is measured from a small nudge and
    not from rest, because on any surface it costs something to leave the place where the samples
    happen to meet.
    """
    moved = rigid.apply(transform, source.points)
    found = closest(moved, target.points, target.mask)
    inlier = (found.square <= distance**2) & source.mask
    counted = inlier.astype(moved.dtype)
    count = jnp.sum(counted)
    valid = jnp.maximum(jnp.sum(source.mask, dtype=count.dtype), 1)
    seen = source.mask & (found.square <= (2 * spacing) ** 2)
    partners = target.points[found.index]
    partners = jnp.concatenate([partners, jnp.ones_like(partners[:, :1])], axis=1)
    rmse = jnp.sqrt(jnp.sum(jnp.where(inlier, found.square, 0)) / jnp.maximum(count, 1))

    normals = target.normals[found.index]
    rows = jnp.concatenate([jnp.cross(moved, normals), normals], axis=1)
    information = jnp.matmul(rows.T, rows * counted[:, None], precision=_HIGHEST)
    information += _POINTWISE * _pointwise_information(moved, counted)
    _, directions = jnp.linalg.eigh(information)  # ascending
    weakest = directions[:, :_WEAKEST].T

    nudges = jnp.array([-_TEXTURE, _TEXTURE, -_NUDGE, _NUDGE], moved.dtype)
    twists = (weakest[:, None] * nudges[:, None]).reshape(-1, 6)
    nudged = jax.vmap(lambda twist: rigid.compose(rigid.exp(twist), transform))(twists)
    lost = _truncated(source, target, nudged, distance).reshape(-1, len(nudges))
    near = (lost[:, 0] + lost[:, 1]) / 2
    rise = jnp.minimum(lost[:, 2], lost[:, 3]) - near

    return Quality(
        fitness=count / valid,
        inlier_rmse=rmse,
        resistance=jnp.clip(rise / jnp.maximum(1 - near, _LEAST), 0, 1),
        weakest=weakest,
        overlap=jnp.sum(seen, dtype=count.dtype) / valid,
        moments=jnp.matmul(partners.T, partners * counted[:, None], precision=_HIGHEST),
    )


def spacing(
    points: Float[Array, "m 3"], neighbors: Int[Array, "m k"], mask: Bool[Array, " m"]
) -> Float[Array, ""]:
    """The median distance from a point to its nearest neighbor."""
    offset = points[neighbors] - points[:, None]
    nearest = jnp.sqrt(jnp.min(jnp.sum(offset * offset, axis=2), axis=1))
    # not `nanmedian`, which counts in float64 if that is enabled
    ordered = jnp.sort(jnp.where(mask, nearest, jnp.inf))
    count = jnp.sum(mask, dtype=jnp.int32)
    return (ordered[(count - 1) // 2] + ordered[count // 2]) / 2


def information_matrix(
    moments: Float[np.ndarray, "4 4"], center: Float[np.ndarray, " 3"], scale: float
) -> Float[np.ndarray, "6 6"]:
    """Open3D's information matrix of the inliers, for a target y = center + scale * unit; float64.

    It is the sum of J'J over the target points. J, the Jacobian of a point, says how a twist
    (rotation first, then translation) moves it. Choi, Zhou & Koltun (2015) use this matrix in pose
    graphs. It is computed from the `moments` of the unit cloud alone, without the points.
    """
    to_caller = np.diag([scale, scale, scale, 1.0])
    to_caller[:3, 3] = center
    moments = to_caller @ np.asarray(moments, np.float64) @ to_caller.T
    second, (x, y, z), count = moments[:3, :3], moments[:3, 3], moments[3, 3]
    turn = np.trace(second) * np.eye(3) - second
    lever = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.block([[turn, lever], [lever.T, count * np.eye(3)]])


def mutual_fit(
    source: Surface, target: Surface, transform: Float[Array, "4 4"], reach: float
) -> Float[Array, ""]:
    """How well two clouds fit under `transform` (source onto target), in [0, 1].

    It is the mean over the points of both clouds of 1 - d^2 / reach^2 (Epanechnikov's kernel; zero
    beyond `reach`) times the cosine between the two normals (zero if they are opposed). Here d is
    the distance to the closest point of the other cloud. Unlike the fitness, this score falls when
    a small part lies in the wrong place on a large one, or when a thin shape is turned over.
    """

    def covered(first: Surface, second: Surface, motion: Array) -> Array:
        found = closest(rigid.apply(motion, first.points), second.points, second.mask)
        normals = rigid.rotate(motion, first.normals)
        cosine = jnp.sum(normals * second.normals[found.index], axis=1)
        near = jnp.maximum(1 - found.square / reach**2, 0)
        valid = first.mask.astype(near.dtype)
        return jnp.sum(near * jnp.maximum(cosine, 0) * valid) / jnp.maximum(jnp.sum(valid), 1)

    there = covered(source, target, transform)
    return (there + covered(target, source, rigid.inverse(transform))) / 2


def _truncated(source: Surface, target: Surface, transforms: Array, distance: float) -> Array:
    """The mean over the source of the truncated squared distance to the target, under each of the
    `transforms`; in [0, 1]."""
    square = squared_distances(source, target, transforms)
    truncated = jnp.minimum(square / distance**2, 1)
    valid = source.mask.astype(truncated.dtype)
    return jnp.sum(truncated * valid, axis=1) / jnp.maximum(jnp.sum(valid), 1)


def _pointwise_information(points: Array, weights: Array) -> Array:
    """The sum of J'J, where J is the Jacobian of a point under a twist (turn, slide), which moves
    the point p by turn x p + slide."""
    turn = -jax.vmap(rigid.skew)(points)
    slide = jnp.broadcast_to(jnp.eye(3, dtype=points.dtype), turn.shape)
    jacobian = jnp.concatenate([turn, slide], axis=2) * weights[:, None, None]
    return jnp.einsum("nji,njk->ik", jacobian, jacobian, precision=_HIGHEST)
