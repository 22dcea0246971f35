"""How good a registration is, and whether the clouds determine it at all, without the truth."""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Float

from cfr_jax import rigid
from cfr_jax.neighbors import closest
from cfr_jax.refinement import Surface, score

_HIGHEST = lax.Precision.HIGHEST
_NUDGE = 0.15  # radians and units of the unit sphere; three times the usual inlier distance
_WEAKEST = 3  # a plane slides along two axes and turns about one; a ball turns about three


@struct.dataclass
class Quality:
    """Measured in the unit sphere, under the answer's transform."""

    fitness: Float[Array, ""]
    """Share of the source with a target point within the inlier distance."""
    inlier_rmse: Float[Array, ""]
    """Root mean square distance of those; 0 where there are none."""
    resistance: Float[Array, " w"]
    """How much the fit suffers from a nudge along each of the weakest directions: 0 not at all (the
    clouds slide or turn freely), 1 all of it is lost."""
    weakest: Float[Array, "w 6"]
    """Those directions: twists in the target's frame, rotation first, of unit length."""


def measure(
    source: Surface, target: Surface, transform: Float[Array, "4 4"], distance: float
) -> Quality:
    """Fitness, inlier error and determinedness of `transform` (source onto target).

    The weakest directions are the eigenvectors with the smallest eigenvalues of the point-to-plane
    information matrix (geometric stability: Gelfand et al., 2003). Noise in the normals hides a
    free direction from its eigenvalue, so each is tried: the source is nudged both ways along it,
    and the rise of the truncated score is compared with all it could rise.
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
    _, directions = jnp.linalg.eigh(information)  # ascending
    weakest = directions[:, :_WEAKEST].T
    here = score(source, target, transform, distance)

    def resistance(direction):
        def nudged(way):
            motion = rigid.exp(way * _NUDGE * direction)
            return score(source, target, rigid.compose(motion, transform), distance)

        rise = jnp.minimum(nudged(1.0), nudged(-1.0)) - here
        return jnp.clip(rise / jnp.maximum(1 - here, 1e-6), 0, 1)

    return Quality(
        fitness=count / jnp.maximum(jnp.sum(source.mask, dtype=count.dtype), 1),
        inlier_rmse=rmse,
        resistance=lax.map(resistance, weakest),
        weakest=weakest,
    )
