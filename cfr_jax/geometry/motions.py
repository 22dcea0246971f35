"""Rigid motions on the host: numpy, float64, no gradients. For the device, see `rigid`.

A motion T is (4, 4) and maps x to R x + t. `second @ first` applies `first`, then `second`.
Quaternions are (x, y, z, w), as in scipy. Angles are in degrees, rotation vectors in radians.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

# How far R R' may be from the identity. Some files store rotations with three digits; float32 alone
# is off by about 1e-6.
TOLERANCE = 1e-3
_LAST_ROW = 1e-6  # a larger deviation makes the matrix a projection, which rounding cannot cause


def motion(
    rotation: Float[np.ndarray, "*batch 3 3"], translation: ArrayLike = 0.0
) -> Float[np.ndarray, "*batch 4 4"]:
    """The motion x -> rotation x + translation."""
    made = np.broadcast_to(np.eye(4), (*rotation.shape[:-2], 4, 4)).copy()
    made[..., :3, :3] = rotation
    made[..., :3, 3] = translation
    return made


def apply(
    transform: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "*n 3"]
) -> Float[np.ndarray, "*n 3"]:
    """Moves points, or a single point."""
    return points @ transform[:3, :3].T + transform[:3, 3]


def rotate(
    transform: Float[np.ndarray, "4 4"], vectors: Float[np.ndarray, "*n 3"]
) -> Float[np.ndarray, "*n 3"]:
    """Rotates directions, such as normals, without translating them."""
    return vectors @ transform[:3, :3].T


def inverse(transform: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """The inverse motion (R', -R' t), in the precision of `transform`."""
    back = np.eye(4, dtype=transform.dtype)
    back[:3, :3] = transform[:3, :3].T
    back[:3, 3] = -transform[:3, :3].T @ transform[:3, 3]
    return back


def angle_between(
    first: Float[np.ndarray, "*#batch 4 4"], second: Float[np.ndarray, "*#batch 4 4"]
) -> Float[np.ndarray, "*batch"]:
    """Angle between the rotations of two motions, in degrees, in [0, 180].

    Computed from the chord: |R1 - R2| = sqrt(8) sin(angle / 2). It resolves 1e-14 degrees. The
    arccos of the trace, which `evaluation.metrics` uses because it is published that way, stops at
    1e-6. Near 180 degrees the chord is accurate to 1e-6.
    """
    difference = first[..., :3, :3] - second[..., :3, :3]
    chord = np.linalg.norm(difference, axis=(-2, -1))
    return np.asarray(np.degrees(2 * np.arcsin(np.minimum(chord / 8**0.5, 1.0))))


def nearest_rotation(matrices: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """The proper rotations closest to (3, 3) matrices in the Frobenius norm (Kabsch, 1976)."""
    u, _, vt = np.linalg.svd(matrices)
    sign = np.linalg.det(u @ vt)
    u[..., :, 2] *= sign[..., None]
    return u @ vt


def nearest_motion(transforms: ArrayLike) -> Float[np.ndarray, "*batch 4 4"]:
    """The matrices in float64, with each (3, 3) part replaced by its `nearest_rotation`."""
    made = np.array(transforms, np.float64)
    made[..., :3, :3] = nearest_rotation(made[..., :3, :3])
    return made


def are_rigid(transforms: Float[np.ndarray, "*batch 4 4"]) -> Bool[np.ndarray, "*batch"]:
    """Which matrices are finite, with a rotation that is proper up to `TOLERANCE` and a last row
    0 0 0 1."""
    finite = np.isfinite(transforms).all(axis=(-2, -1))
    # the entries of a rotation are at most 1, and the squares of large ones overflow
    small = (np.abs(np.nan_to_num(transforms[..., :3, :3])) < 2).all(axis=(-2, -1))
    finite = finite & small
    sound = np.where(finite[..., None, None], transforms, 0)
    turns = sound[..., :3, :3]
    off = np.abs(turns @ turns.swapaxes(-1, -2) - np.eye(3)).max(axis=(-2, -1))
    last = np.abs(sound[..., 3, :] - (0, 0, 0, 1)).max(axis=-1)
    with np.errstate(all="ignore"):  # of entries near the smallest float
        proper = np.linalg.det(turns) > 0
    return np.asarray(finite & (off <= TOLERANCE) & proper & (last <= _LAST_ROW))


def check_rigid(
    name: str, transforms: ArrayLike, *, several: bool = False
) -> Float[np.ndarray, "*batch 4 4"]:
    """Returns one motion, or `several` along leading axes, as float64.

    Raises ValueError, with a message that begins with `name`, if the shape is wrong or a motion is
    not rigid.
    """
    found = np.asarray(transforms, np.float64)
    if found.shape[-2:] != (4, 4) or (found.ndim > 2 and not several):
        raise ValueError(f"{name}: got shape {found.shape}, wanted a rigid motion, (4, 4)")
    rigid = are_rigid(found)
    if rigid.all():
        return found
    place = np.unravel_index(np.argmin(rigid), rigid.shape)
    which = f"[{', '.join(map(str, place))}]" if place else ""
    raise ValueError(
        f"{name}{which}: got a matrix that is not rigid ({_fault(found[place])}), wanted a proper "
        "rotation, a translation, and a last row 0 0 0 1"
    )


def _fault(transform: Float[np.ndarray, "4 4"]) -> str:
    if not np.isfinite(transform).all():
        return "not all numbers are finite"
    turn = np.clip(transform[:3, :3], -1e9, 1e9)  # whose squares are numbers
    off = np.abs(turn @ turn.T - np.eye(3)).max()
    if off > TOLERANCE:
        return f"R Rᵀ differs from the identity by {off:.2g}"
    if np.linalg.det(turn) < 0:
        return "R is a reflection"
    return f"the last row is {transform[3].tolist()}"


def from_xyzw(
    quaternions: Float[np.ndarray, "*batch 4"],
) -> Float[np.ndarray, "*batch 3 3"]:
    """Rotations for quaternions (x, y, z, w) of any nonzero length."""
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    return _of_unit(quaternions / np.sqrt(x * x + y * y + z * z + w * w)[..., None])


def to_xyzw(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 4"]:
    """Unit quaternion (x, y, z, w), w >= 0, of a rotation or of a matrix that is nearly one.

    It is the eigenvector for the largest eigenvalue of a symmetric matrix that is linear in the
    rotation (Bar-Itzhack, 2000).
    """
    (a, b, c), (d, e, f), (g, h, i) = rotation
    symmetric = np.array(
        [
            [a - e - i, b + d, c + g, h - f],
            [b + d, e - a - i, f + h, c - g],
            [c + g, f + h, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    quaternion = np.linalg.eigh(symmetric)[1][:, -1]
    return quaternion if quaternion[3] >= 0 else -quaternion


def from_rotvec(turns: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Rotations about the directions of `turns`, by angles equal to their lengths in radians."""
    x, y, z = np.moveaxis(turns, -1, 0)
    angle = np.sqrt(x * x + y * y + z * z)[..., None]
    square = angle * angle
    small = angle <= 1e-3
    # sin(angle / 2) / angle; near zero, where the quotient loses digits, from its series
    series = 0.5 - square / 48 + square * square / 3840
    scale = np.where(small, series, np.sin(angle / 2) / np.where(small, 1, angle))
    return _of_unit(np.concatenate([scale * turns, np.cos(angle / 2)], axis=-1))


def to_rotvec(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 3"]:
    """The inverse of `from_rotvec`: a rotation vector of length at most pi, in radians."""
    *axis, w = to_xyzw(rotation)
    sine = float(np.linalg.norm(axis))
    return np.array(axis) * (2 * np.arctan2(sine, w) / sine if sine else 2.0)


def _of_unit(quaternions: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 3 3"]:
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    rows = (
        (x * x - y * y - z * z + w * w, 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), -x * x + y * y - z * z + w * w, 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), -x * x - y * y + z * z + w * w),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def cover(count: int) -> Float[np.ndarray, "count 3 3"]:
    """`count` rotations spread evenly over SO(3). A prefix of them is not spread evenly.

    Super-Fibonacci spirals (Alexa, CVPR 2022): quaternion i winds around two circles, at angles
    that advance by 1 / sqrt(2) and by 1 / psi of a turn with psi^4 = psi + 4, while its weight
    moves evenly from one circle to the other. No rotation is farther from its nearest one than
    61 degrees for 64 rotations, 46 for 128, and 37 for 256 (measured in
    `tests/geometry/test_motions_cover.py`). Raises ValueError for a count below 1.
    """
    if count < 1:
        raise ValueError(f"count: got {count} rotations, wanted at least 1")
    psi = 1.5337511687552043
    place = np.arange(count) + 0.5
    share = place / count
    first, second = 2 * np.pi * place / np.sqrt(2), 2 * np.pi * place / psi
    inner, outer = np.sqrt(share), np.sqrt(1 - share)
    parts = (np.sin(first), inner), (np.cos(first), inner), (np.sin(second), outer)
    quaternions = [weight * wave for wave, weight in (*parts, (np.cos(second), outer))]
    return from_xyzw(np.stack(quaternions, axis=1))
