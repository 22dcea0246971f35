"""The motion between two clouds of which only vectors are known: Gauss-Newton on their difference.

Inverse-compositional: the Jacobian is that of the cloud that stays, taken once, by finite
differences along the six twists (rotation first).
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from cfr_jax.geometry import rigid
from cfr_jax.geometry.eigen import solve_positive

_HIGHEST = lax.Precision.HIGHEST
_STILL = 1e-7
# Of the normal equations with unit diagonal: with a pivot below the first, float32 holds nothing of
# the smallest eigenvalue, and the second is added to all of them.
_SINGULAR = 1e-5
_RIDGE = 1e-2
# What a step is cut to, which no step of use reaches: half a turn, and so many radii of the cloud.
_TURN, _RADII = jnp.pi, 10

Encode = Callable[[Float[Array, "n 3"]], Float[Array, " c"]]


def jacobian(
    encode: Encode, points: Float[Array, "n 3"], steps: Float[Array, " 6"]
) -> tuple[Float[Array, " c"], Float[Array, "c 6"]]:
    """The vector of a cloud, and its derivative by twists that move the cloud."""
    vector = encode(points)

    def along(k: Array, step: Array) -> Array:
        twist = jnp.where(jnp.arange(6) == k, -step, 0)
        return (vector - encode(rigid.apply(rigid.exp(twist), points))) / step

    return vector, jax.vmap(along, out_axes=1)(jnp.arange(6), steps)


def steps_of(
    encode: Encode,
    points: Float[Array, "n 3"],
    wanted: Float[Array, " c"],
    slope: Float[Array, "c 6"],
    count: int,
) -> Float[Array, "count 4 4"]:
    """The motion after each of `count` steps that bring the vector of the points to the `wanted`
    one, of the cloud whose derivative is `slope`.

    As published, without damping. Where the normal equations are singular in float32 (a sphere does
    not tell how it is turned), a ridge makes the steps in these directions short; the published
    program stops with an error there. And a step is at most half a turn and ten radii long.
    """
    system = jnp.matmul(slope.T, slope, precision=_HIGHEST)
    diagonal = jnp.diagonal(system)
    moving = diagonal > 0
    scale = jnp.where(moving, lax.rsqrt(jnp.where(moving, diagonal, 1)), 0)
    unit = system * scale[:, None] * scale + jnp.diag(jnp.where(moving, 0, 1).astype(scale.dtype))
    one = jnp.eye(6, dtype=unit.dtype)
    pivots = jnp.diagonal(jnp.linalg.cholesky(lax.stop_gradient(unit))) ** 2  # NaN where it stops
    unit = unit + jnp.where(jnp.min(pivots) > _SINGULAR, 0, _RIDGE * one)
    inverse = jax.vmap(solve_positive, (None, 0))(unit, one)

    def step(motion: Array, _: None) -> tuple[Array, Array]:
        residual = encode(rigid.apply(motion, points)) - wanted
        pull = scale * jnp.matmul(slope.T, residual, precision=_HIGHEST)
        twist = -scale * jnp.matmul(inverse, pull, precision=_HIGHEST)
        twist = jnp.where(jnp.max(jnp.abs(twist)) < _STILL, 0, twist / _excess(twist, radius))
        motion = rigid.compose(rigid.exp(twist), motion)
        return motion, motion

    radius = lax.stop_gradient(jnp.max(jnp.abs(points)))
    start = jnp.eye(4, dtype=slope.dtype)
    return lax.scan(step, start, length=count)[1]


def _excess(twist: Float[Array, " 6"], radius: Float[Array, ""]) -> Float[Array, ""]:
    """How many times too long a step is; 1 where it is not."""
    turn, slide = jnp.max(jnp.abs(twist[:3])), jnp.max(jnp.abs(twist[3:]))
    least = jnp.finfo(twist.dtype).tiny
    return jnp.maximum(jnp.maximum(turn / _TURN, slide / jnp.maximum(_RADII * radius, least)), 1)
