"""Local refinement of a registration: generalized ICP with a shrinking, robust cut.

The network brings a cloud to within a few degrees of the target. What is left is a smooth
least-squares problem. Generalized ICP (Segal, Haehnel & Thrun, 2009) models each point as a small
plane. It copes with a wide cut better than point-to-plane distances do, and it needs only the
direction of the normals, not their sign.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from cfr_jax.geometry import rigid
from cfr_jax.geometry.closest import closest
from cfr_jax.geometry.eigen import solve_positive
from cfr_jax.refine.surfaces import Fit, Surface

_HIGHEST = lax.Precision.HIGHEST


class Stage(NamedTuple):
    """How far apart paired points may be, and the shape of the small plane at each point."""

    cut: float
    """The largest distance of a pair, in units of the unit sphere."""
    thickness: float
    """The variance of a point across its plane, as a share of the variance along the plane."""


# The first cut is wide enough for the error that a network leaves. The last is no wider than the
# noise and the spacing of the surface. Thin planes slide past each other, so they converge from
# afar. Thick ones, halfway between planes and balls, also use the points themselves and end more
# precisely on noisy clouds.
STAGES = (Stage(0.2, 0.01), Stage(0.1, 0.01), Stage(0.05, 0.1))
CUT = STAGES[-1].cut
_STEPS_PER_CUT = 12
_SETTLED = 1e-5  # radians and units of the unit sphere; a smaller update ends a stage


def refine(
    source: Surface,
    target: Surface,
    initial: Float[Array, "4 4"],
    stages: tuple[Stage, ...] = STAGES,
) -> Fit:
    """Refines `initial`, which maps source onto target, within the unit sphere.

    The motion at which `descend` ends is kept only if it scores no worse than `initial` (`scores`
    at the last cut).
    """
    transform, steps, settled = descend(source, target, initial, stages)
    before, after = scores(source, target, jnp.stack([initial, transform]), stages[-1].cut)
    improved = after <= before
    return Fit(jnp.where(improved, transform, initial), improved, settled, steps)


def descend(
    source: Surface,
    target: Surface,
    initial: Float[Array, "4 4"],
    stages: tuple[Stage, ...] = STAGES,
) -> tuple[Float[Array, "4 4"], Int[Array, ""], Bool[Array, ""]]:
    """Runs generalized ICP. Returns the motion at which it ends, the number of steps, and whether
    the last stage settled.

    Each stage repeats three things until nothing moves: it pairs every source point with its
    closest target point, gives the pairs weights that fall to zero at the cut (Tukey's biweight),
    and takes a Gauss-Newton step on SE(3).
    """

    def run(transform: Array, stage: Stage) -> tuple[Array, tuple[Array, Array]]:
        transform, steps, settled = _run_stage(source, target, transform, stage)
        return transform, (steps, settled)

    # a scan, so that the stages share one compiled loop
    transform, (steps, settled) = lax.scan(run, initial, Stage(*jnp.array(stages, initial.dtype).T))
    return transform, jnp.sum(steps), settled[-1]


def scores(
    source: Surface, target: Surface, transforms: Float[Array, "k 4 4"], cut: float
) -> Float[Array, " k"]:
    """The mean of Tukey's biweight loss over the points of the source, under each of the
    `transforms`; in [0, 1].

    A point at distance d from the target has the loss 1 - (1 - d^2 / cut^2)^3, or 1 beyond the cut.
    The weights in `descend` are those of this loss.
    """
    square = squared_distances(source, target, transforms)
    loss = 1 - jnp.maximum(1 - square / cut**2, 0) ** 3
    valid = source.mask.astype(loss.dtype)
    return jnp.sum(loss * valid, axis=1) / jnp.maximum(jnp.sum(valid), 1)


def squared_distances(
    source: Surface, target: Surface, transforms: Float[Array, "k 4 4"]
) -> Float[Array, "k n"]:
    """The squared distance from each point of the source, moved by each of the `transforms`, to the
    closest point of the target. One search serves all transforms."""
    moved = jax.vmap(rigid.apply, (0, None))(transforms, source.points)
    found = closest(moved.reshape(-1, 3), target.points, target.mask)
    return found.square.reshape(moved.shape[:2])


def _run_stage(
    source: Surface, target: Surface, transform: Array, stage: Stage
) -> tuple[Array, Array, Array]:
    def unsettled(state: tuple[Array, Array, Array]) -> Array:
        _, step, size = state
        return (step < _STEPS_PER_CUT) & (size > _SETTLED)

    def step(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        transform, count, _ = state
        twist = _gauss_newton(source, target, transform, stage)
        return rigid.compose(rigid.exp(twist), transform), count + 1, jnp.max(jnp.abs(twist))

    start = (transform, jnp.zeros((), jnp.int32), jnp.array(jnp.inf, transform.dtype))
    transform, steps, size = lax.while_loop(unsettled, step, start)
    return transform, steps, size <= _SETTLED


def _gauss_newton(source: Surface, target: Surface, transform: Array, stage: Stage) -> Array:
    """The twist that minimizes sum_i w_i r_i' M_i r_i, with r = T x - y linearized in the twist."""
    found = closest(rigid.apply(transform, source.points), target.points, target.mask)
    partners = target.points[found.index], target.normals[found.index]
    return solve(*normal_equations(source, *partners, transform, stage))


def normal_equations(
    source: Surface,
    partners: Float[Array, "n 3"],
    partner_normals: Float[Array, "n 3"],
    transform: Float[Array, "4 4"],
    stage: Stage,
) -> tuple[Float[Array, "6 6"], Float[Array, " 6"]]:
    """The normal equations of one Gauss-Newton step, summed over the pairs of source points and
    partners. The sums over parts of a cloud can be added up. Pairs further apart than the cut have
    weight zero."""
    moved = rigid.apply(transform, source.points)
    residual = moved - partners
    weight = jnp.maximum(1 - jnp.sum(residual**2, axis=1) / stage.cut**2, 0) ** 2
    weight = jnp.where(source.mask, weight, 0)
    normals = rigid.rotate(transform, source.normals), partner_normals
    ours, theirs = (_plane(n, stage.thickness) for n in normals)
    metric = weight[:, None, None] * _inverse_symmetric(ours + theirs)
    # a left twist (turn, slide) moves p by turn x p + slide
    turn = -jax.vmap(rigid.skew)(moved)
    jacobian = jnp.concatenate(
        [turn, jnp.broadcast_to(jnp.eye(3, dtype=turn.dtype), turn.shape)], axis=2
    )
    weighted = jnp.einsum("nij,nik->njk", metric, jacobian, precision=_HIGHEST)
    system = jnp.einsum("nji,njk->ik", jacobian, weighted, precision=_HIGHEST)
    return system, jnp.einsum("nij,ni->j", weighted, residual, precision=_HIGHEST)


def solve(system: Float[Array, "6 6"], pull: Float[Array, " 6"]) -> Float[Array, " 6"]:
    """Solves the normal equations for the step, a left twist with the rotation first."""
    # damping gives no motion along directions that the pairs do not determine, such as the turn
    # of a line about itself
    damping = 1e-6 * jnp.trace(system) + jnp.finfo(system.dtype).tiny
    return -solve_positive(system + damping * jnp.eye(6, dtype=system.dtype), pull)


def _plane(normals: Array, thickness: Array | float) -> Array:
    """The covariance of a small plane: `thickness` along the normal and 1 within the plane. Where
    the normal is zero, it is the identity, a ball."""
    outer = normals[:, :, None] * normals[:, None, :]
    return jnp.eye(3, dtype=normals.dtype) - (1 - thickness) * outer


def _inverse_symmetric(m: Array) -> Array:
    """The inverses of (n, 3, 3) symmetric matrices, by cofactors. Those used here are far from
    singular."""
    a, b, c = m[:, 0, 0], m[:, 0, 1], m[:, 0, 2]
    d, e, f = m[:, 1, 1], m[:, 1, 2], m[:, 2, 2]
    cofactors = jnp.stack(
        [d * f - e * e, c * e - b * f, b * e - c * d]
        + [c * e - b * f, a * f - c * c, b * c - a * e]
        + [b * e - c * d, b * c - a * e, a * d - b * b],
        axis=1,
    )
    determinant = a * cofactors[:, 0] + b * cofactors[:, 1] + c * cofactors[:, 2]
    return (cofactors / determinant[:, None]).reshape(-1, 3, 3)
