"""Rigid motions of 3D space: fitting, composing, and measuring them.

A motion is a (4, 4) matrix `T` acting on column vectors, `T @ [x; 1]`. Its name says what it does:
`transform` maps source onto target. Twists are (6,) vectors: the rotation vector, then the
translation part. `exp` is the matrix exponential of SE(3) (Murray, Li & Sastry, 1994, ch. 2).

All products here ask for full float32 precision. Otherwise accelerators would round their inputs
(TF32, bfloat16), and a rotation would lose three digits.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from cfr_jax.geometry.eigen import leading_eigenvector, pseudo_inverse, size_of

_HIGHEST = lax.Precision.HIGHEST


def from_parts(
    rotation: Float[Array, "3 3"], translation: Float[Array, " 3"]
) -> Float[Array, "4 4"]:
    """The motion x -> rotation @ x + translation."""
    top = jnp.concatenate([rotation, translation[:, None]], axis=1)
    return jnp.concatenate([top, jnp.array([[0, 0, 0, 1]], top.dtype)], axis=0)


def apply(transform: Float[Array, "4 4"], points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Moves points. For directions, such as normals, use `rotate`."""
    return rotate(transform, points) + transform[:3, 3]


def rotate(transform: Float[Array, "4 4"], vectors: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Rotates directions: applies the rotation of `transform` without its translation."""
    return jnp.matmul(vectors, transform[:3, :3].T, precision=_HIGHEST)


def compose(second: Float[Array, "4 4"], first: Float[Array, "4 4"]) -> Float[Array, "4 4"]:
    """The motion that applies `first`, then `second`."""
    return jnp.matmul(second, first, precision=_HIGHEST)


def inverse(transform: Float[Array, "4 4"]) -> Float[Array, "4 4"]:
    """The inverse motion; exact for rigid motions, wrong for any other matrix."""
    back = transform[:3, :3].T
    return from_parts(back, -jnp.matmul(back, transform[:3, 3], precision=_HIGHEST))


@jax.jit  # so that it is traced once, not in every iteration
def fit_rigid(
    source: Float[Array, "n 3"], target: Float[Array, "n 3"], weights: Float[Array, " n"]
) -> Float[Array, "4 4"]:
    """Rigid motion that maps `source` onto `target`, row by row.

    Minimizes sum_n weights_n |R source_n + t - target_n|^2 (Kabsch, 1976; Umeyama, 1991). The
    weights are divided by their sum + 1e-5, as in the paper. They must be non-negative. The
    rotation is proper. If the minimizer is not unique (collinear or identical points, zero
    weights), the result is one of the minimizers, and the gradient is zero in the directions that
    are not determined.
    """
    weights = weights / (jnp.sum(weights) + 1e-5)
    # The rotation does not depend on the scale of either cloud. Scaling both to about one keeps the
    # covariance within float32's range for clouds of any size, and needs no gradient.
    size_source, size_target = (size_of(cloud) for cloud in (source, target))
    small_source, small_target = source / size_source, target / size_target
    center_source = jnp.matmul(weights, small_source, precision=_HIGHEST)
    center_target = jnp.matmul(weights, small_target, precision=_HIGHEST)
    covariance = jnp.matmul(
        (small_target - center_target).T,
        weights[:, None] * (small_source - center_source),
        precision=_HIGHEST,
    )
    rotation = nearest_rotation(covariance)
    turned = jnp.matmul(rotation, center_source * size_source, precision=_HIGHEST)
    return from_parts(rotation, center_target * size_target - turned)


@jax.custom_jvp
def nearest_rotation(matrix: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """The proper rotation R that maximizes trace(R^T matrix).

    Horn (1987): the quaternion of R is the leading eigenvector of a symmetric 4x4 matrix that is
    linear in `matrix`. Reflections need no special case, and no step divides by a singular value,
    so every finite matrix has a result (zero gives the identity).

    The derivative does not pass through the eigenvectors. With P = R^T matrix (symmetric at the
    optimum), dR = R [w]x where (tr(P) I - P) w = vee(R^T dmatrix - dmatrix^T R). That system is
    singular exactly where R is not unique. There its pseudo-inverse is used, with a relative
    threshold, so that the gradient stays finite at every scale.
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = (matrix / size_of(matrix)).reshape(9)
    horn = jnp.array(
        [
            [xx + yy + zz, zy - yz, xz - zx, yx - xy],
            [zy - yz, xx - yy - zz, xy + yx, xz + zx],
            [xz - zx, xy + yx, yy - xx - zz, yz + zy],
            [yx - xy, xz + zx, yz + zy, zz - xx - yy],
        ]
    )
    return from_wxyz(leading_eigenvector(horn))


@nearest_rotation.defjvp
def _nearest_rotation_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (matrix,), (tangent,) = primals, tangents
    rotation = nearest_rotation(matrix)
    stretch = jnp.matmul(rotation.T, matrix, precision=_HIGHEST)
    stretch = (stretch + stretch.T) / 2
    system = jnp.trace(stretch) * jnp.eye(3, dtype=matrix.dtype) - stretch
    scale = size_of(system)
    change = jnp.matmul(rotation.T, tangent / scale, precision=_HIGHEST)
    inverse = pseudo_inverse(system / scale)
    turn = jnp.matmul(inverse, _vee(change - change.T), precision=_HIGHEST)
    return rotation, jnp.matmul(rotation, skew(turn), precision=_HIGHEST)


def from_wxyz(quaternion: Float[Array, " 4"]) -> Float[Array, "3 3"]:
    """Rotation for a quaternion (w, x, y, z) of any nonzero length."""
    w, x, y, z = quaternion * lax.rsqrt(jnp.sum(quaternion * quaternion))
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def skew(vector: Float[Array, " 3"]) -> Float[Array, "3 3"]:
    """The matrix of the cross product: skew(a) @ b = a x b."""
    x, y, z = vector
    zero = jnp.zeros_like(x)
    return jnp.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])


def _vee(matrix: Float[Array, "3 3"]) -> Float[Array, " 3"]:
    return jnp.array([matrix[2, 1], matrix[0, 2], matrix[1, 0]])


def exp(twist: Float[Array, " 6"]) -> Float[Array, "4 4"]:
    """The motion for a twist (rotation vector, translation part); differentiable at zero."""
    turn, slide = twist[:3], twist[3:]
    square = jnp.sum(turn * turn)
    small = square < 1e-4  # here the next terms of the series are below float32's resolution
    safe = jnp.where(small, 1, square)
    angle = jnp.sqrt(safe)
    a = jnp.where(small, 1 - square / 6, jnp.sin(angle) / angle)
    b = jnp.where(small, 0.5 - square / 24, 2 * jnp.sin(angle / 2) ** 2 / safe)
    c = jnp.where(small, 1 / 6 - square / 120, (angle - jnp.sin(angle)) / (safe * angle))
    cross = skew(turn)
    cross_twice = jnp.matmul(cross, cross, precision=_HIGHEST)
    identity = jnp.eye(3, dtype=twist.dtype)
    rotation = identity + a * cross + b * cross_twice
    translation = jnp.matmul(identity + b * cross + c * cross_twice, slide, precision=_HIGHEST)
    return from_parts(rotation, translation)


def log(transform: Float[Array, "4 4"]) -> Float[Array, " 6"]:
    """The inverse of `exp`: the twist of a motion, with a rotation vector of length at most pi."""
    quaternion = to_wxyz(transform[:3, :3])
    w, axis = quaternion[0], quaternion[1:]
    square = jnp.sum(axis * axis)
    small = square < 1e-6
    sine = jnp.sqrt(jnp.where(small, 1, square))
    half = jnp.arctan2(sine, w)
    turn = axis * jnp.where(small, 2 / w, 2 * half / sine)
    # inverse of the left Jacobian: I - K/2 + d K^2
    half = jnp.where(small, 0.5, half)
    angle = 2 * half
    d = jnp.where(small, 1 / 12, (1 - half * jnp.cos(half) / jnp.sin(half)) / (angle * angle))
    cross = skew(turn)
    back = jnp.eye(3, dtype=turn.dtype) - cross / 2
    back = back + d * jnp.matmul(cross, cross, precision=_HIGHEST)
    return jnp.concatenate([turn, jnp.matmul(back, transform[:3, 3], precision=_HIGHEST)])


def to_wxyz(rotation: Float[Array, "3 3"]) -> Float[Array, " 4"]:
    """Unit quaternion (w, x, y, z), w >= 0, of a rotation (Shepperd, 1978: largest part first)."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    # Row k is 4 q_k q, so all four rows are parallel. The longest is the best conditioned.
    rows = jnp.array(
        [
            [1 + a + e + i, h - f, c - g, d - b],
            [h - f, 1 + a - e - i, b + d, c + g],
            [c - g, b + d, 1 - a + e - i, f + h],
            [d - b, c + g, f + h, 1 - a - e + i],
        ]
    )
    row = rows[jnp.argmax(jnp.diagonal(rows))]
    row = row * lax.rsqrt(jnp.sum(row * row))
    return jnp.where(row[0] < 0, -row, row)


def rotation_error(transform: Float[Array, "4 4"], truth: Float[Array, "4 4"]) -> Float[Array, ""]:
    """Angle in degrees between the rotations of two motions.

    Computed from the chord |R - R_truth|, which is accurate down to float32's 1e-5 degrees. The
    usual arccos of the trace cannot resolve angles below 0.03 degrees.
    """
    chord = jnp.sum((transform[:3, :3] - truth[:3, :3]) ** 2)
    half_sine = jnp.sqrt(jnp.where(chord > 0, chord / 8, 0))
    return jnp.rad2deg(2 * jnp.arcsin(jnp.minimum(half_sine, 1)))


def translation_error(
    transform: Float[Array, "4 4"], truth: Float[Array, "4 4"]
) -> Float[Array, ""]:
    """Length of the translation of truth^-1 o transform, in the clouds' unit."""
    square = jnp.sum((transform[:3, 3] - truth[:3, 3]) ** 2)
    apart = square > 0  # at zero, the derivative is defined as zero
    return jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1)), 0)
