"""How good a registration is, and whether the clouds determine it at all, without the truth."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Float

from cfr_jax import rigid
from cfr_jax.neighbors import closest
from cfr_jax.refinement import Surface, score

_HIGHEST = lax.Precision.HIGHEST
_NUDGE = 0.15  # radians and units of the unit sphere; three times the usual inlier distance
_TEXTURE = 0.06  # nudges as small as this feel the sampling: where the points lie on the surface
_LEAST = 0.2  # where less of the fit is left to lose, a rise is chance
_POINTWISE = 1e-3  # share of point-to-point information: settles what normals leave open
_WEAKEST = 3  # a plane slides along two axes and turns about one; a ball turns about three


@struct.dataclass
class Quality:
    """Measured in the unit sphere, under the answer's transform."""

    fitness: Float[Array, ""]
    """Share of the source with a target point within the inlier distance."""
    inlier_rmse: Float[Array, ""]
    """Root mean square distance of those; 0 where there are none."""
    resistance: Float[Array, " w"]
    """How much the fit suffers from a nudge along each of the weakest directions: about 0 not at
    all (the clouds slide or turn freely), 1 all of it is lost."""
    weakest: Float[Array, "w 6"]
    """Those directions: twists in the target's frame, rotation first, of unit length."""


def measure(
    source: Surface, target: Surface, transform: Float[Array, "4 4"], distance: float
) -> Quality:
    """Fitness, inlier error and determinedness of `transform` (source onto target).

    The weakest directions are the eigenvectors with the smallest eigenvalues of the point-to-plane
    information matrix (geometric stability: Gelfand et al., 2003), to which a little point-to-point
    information is added: of directions that no normal resists, those that move the fewest points
    come first (a line turns about itself before it slides). Noise in the normals hides a free
    direction from its eigenvalue, so each is tried: the source is nudged both ways along it, and
    the rise of the truncated score is compared with all it could rise. It is measured from a small
    nudge on, not from rest: leaving the place where the samples happen to meet costs something on
    any surface.
    """
    moved = rigid.apply(transform, source.points)
    found = closest(moved, target.points, target.mask)
    inlier = (found.square <= distance**2) & source.mask
    counted = inlier.astype(moved.dtype)
    count = jnp.sum(counted)
    rmse = jnp.sqrt(jnp.sum(jnp.where(inlier, found.square, 0)) / jnp.maximum(count, 1))

    normals = target.normals[found.index]
    rows = jnp.concatenate([jnp.cross(moved, normals), normals], axis=1)
    information = jnp.matmul(rows.T, rows * counted[:, None], precision=_HIGHEST)
    information += _POINTWISE * _pointwise_information(moved, counted)
    _, directions = jnp.linalg.eigh(information)  # ascending
    weakest = directions[:, :_WEAKEST].T

    def resistance(direction):
        def nudged(step):
            motion = rigid.exp(step * direction)
            return score(source, target, rigid.compose(motion, transform), distance)

        steps = jnp.array([-_TEXTURE, _TEXTURE, -_NUDGE, _NUDGE], moved.dtype)
        near_back, near_ahead, back, ahead = lax.map(nudged, steps)
        near = (near_back + near_ahead) / 2
        rise = jnp.minimum(back, ahead) - near
        return jnp.clip(rise / jnp.maximum(1 - near, _LEAST), 0, 1)

    return Quality(
        fitness=count / jnp.maximum(jnp.sum(source.mask, dtype=count.dtype), 1),
        inlier_rmse=rmse,
        resistance=lax.map(resistance, weakest),
        weakest=weakest,
    )


def _pointwise_information(points, weights):
    """Sum of J'J, J how a twist (turn, slide) moves a point: turn x p + slide."""
    turn = -jax.vmap(rigid.skew)(points)
    slide = jnp.broadcast_to(jnp.eye(3, dtype=points.dtype), turn.shape)
    jacobian = jnp.concatenate([turn, slide], axis=2) * weights[:, None, None]
    return jnp.einsum("nji,njk->ik", jacobian, jacobian, precision=_HIGHEST)
