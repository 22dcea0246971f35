"""The Lie group of rigid motions, SE(3), on the host: numpy, float64, batched.

A twist is (..., 6): a rotation vector in radians, then a translation, as everywhere in this
package. `exp` of a twist is the motion that turns and slides along it for one unit of time.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from cfr_jax.geometry import motions

# Of the series of `left_jacobian`: the next term is below 1e-13 for turns of up to pi.
_TERMS = 30


def exp(twists: Float[np.ndarray, "*batch 6"]) -> Float[np.ndarray, "*batch 4 4"]:
    """The motions of twists."""
    turns, slides = twists[..., :3], twists[..., 3:]
    return motions.motion(
        motions.from_rotvec(turns), np.einsum("...ij,...j->...i", _slope(turns), slides)
    )


def log(transforms: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 6"]:
    """The inverse of `exp`: twists whose turns are at most pi long."""
    turns = np.reshape(
        Rotation.from_matrix(transforms[..., :3, :3].reshape(-1, 3, 3)).as_rotvec(),
        (*transforms.shape[:-2], 3),
    )
    slides = np.linalg.solve(_slope(turns), transforms[..., :3, 3, None])[..., 0]
    return np.concatenate([turns, slides], axis=-1)


def inverse(transforms: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 4 4"]:
    """The inverse of each of many motions."""
    back = transforms[..., :3, :3].swapaxes(-1, -2)
    return motions.motion(back, -np.einsum("...ij,...j->...i", back, transforms[..., :3, 3]))


def adjoint(transforms: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 6 6"]:
    """Ad(T), which carries a twist through a motion: T exp(x) = exp(Ad(T) x) T."""
    turn = transforms[..., :3, :3]
    made = np.zeros((*transforms.shape[:-2], 6, 6))
    made[..., :3, :3] = made[..., 3:, 3:] = turn
    made[..., 3:, :3] = skew(transforms[..., :3, 3]) @ turn
    return made


def left_jacobian(twists: Float[np.ndarray, "*batch 6"]) -> Float[np.ndarray, "*batch 6 6"]:
    """J with exp(x + d) = exp(J(x) d) exp(x) to first order; J(-x) is the right one.

    It is the sum of ad(x)^n / (n + 1)! (Barfoot, State Estimation for Robotics, 2017, section 7.1).
    """
    small = np.zeros((*twists.shape[:-1], 6, 6))
    small[..., :3, :3] = small[..., 3:, 3:] = skew(twists[..., :3])
    small[..., 3:, :3] = skew(twists[..., 3:])
    term = made = np.broadcast_to(np.eye(6), small.shape)
    for order in range(2, _TERMS + 2):
        term = term @ small / order
        made = made + term
    return made


def skew(vectors: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """The matrices that take the cross product with vectors: skew(a) b = a x b."""
    made = np.zeros((*vectors.shape[:-1], 3, 3))
    x, y, z = np.moveaxis(vectors, -1, 0)
    made[..., 2, 1], made[..., 0, 2], made[..., 1, 0] = x, y, z
    made[..., 1, 2], made[..., 2, 0], made[..., 0, 1] = -x, -y, -z
    return made


def _slope(turns: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """How a slide is bent by the turn that goes on with it: the left Jacobian of SO(3)."""
    angle = np.linalg.norm(turns, axis=-1)[..., None, None]
    small = angle < 1e-3
    safe = np.where(small, 1.0, angle)
    square = angle * angle
    # near zero, where the quotients lose digits, from their series
    first = np.where(small, 0.5 - square / 24, (1 - np.cos(safe)) / safe**2)
    second = np.where(small, 1 / 6 - square / 120, (safe - np.sin(safe)) / safe**3)
    cross = skew(turns)
    return np.eye(3) + first * cross + second * (cross @ cross)
