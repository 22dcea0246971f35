"""Local refinement of a registration: generalized ICP with a shrinking, robust cut.

The network brings a cloud to within a few degrees; what is left is a smooth least-squares problem.
Generalized ICP (Segal, Haehnel & Thrun, 2009) models each point as a small plane: it forgives a
wide cut better than point-to-plane distances do, and needs only the direction of normals, not their
sign.
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
    """How far points may be from each other, and what shape they have."""

    cut: float
    """In units of the unit sphere."""
    thickness: float
    """Variance of a point's plane across it, as a share of that along it."""


# Wide enough at first for what a network leaves, and at last no wider than the surface's own noise
# and spacing. Thin planes slide past each other and find the way from afar; thick ones, between
# planes and balls, use the points themselves, and end more precisely on noisy clouds.
STAGES = (Stage(0.2, 0.01), Stage(0.1, 0.01), Stage(0.05, 0.1))
CUT = STAGES[-1].cut
_STEPS_PER_CUT = 12
_SETTLED = 1e-5  # radians and units: smaller updates end a stage


def refine(
    source: Surface,
    target: Surface,
    initial: Float[Array, "4 4"],
    stages: tuple[Stage, ...] = STAGES,
) -> Fit:
    """Refines `initial`, which maps source onto target, within the unit sphere.

    Where `descend` ends is kept only if it scores no worse than `initial` (`score` at the last
    cut).
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
    """Where generalized ICP ends, in how many steps, and whether the last stage came to rest.

    In each stage: pair every source point with its closest target point, weigh the pairs
    down to zero at the cut (Tukey's biweight), take a Gauss-Newton step on SE(3), until nothing
    moves.
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
    """Mean over the source of Tukey's biweight loss of the distance to the target, under each of
    the `transforms`; in [0, 1].

    It is 1 - (1 - d^2 / cut^2)^3, and 1 beyond the cut: what the weights of a descent belong to.
    """
    square = squared_distances(source, target, transforms)
    loss = 1 - jnp.maximum(1 - square / cut**2, 0) ** 3
    valid = source.mask.astype(loss.dtype)
    return jnp.sum(loss * valid, axis=1) / jnp.maximum(jnp.sum(valid), 1)


def squared_distances(
    source: Surface, target: Surface, transforms: Float[Array, "k 4 4"]
) -> Float[Array, "k n"]:
    """From each point of the source, moved by each of the `transforms`, to the closest of the
    target: one search for all of them."""
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
    """The twist that lessens sum_i w_i r_i' M_i r_i the most, r = T x - y, linearized."""
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
    """What one Gauss-Newton step solves, summed over the pairs of source points and partners;
    sums over parts of a cloud add up. Pairs further apart than the cut have no say."""
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
    """The step: a left twist, rotation first."""
    # keeps directions that nothing determines (a line turning about itself) at rest
    damping = 1e-6 * jnp.trace(system) + jnp.finfo(system.dtype).tiny
    return -solve_positive(system + damping * jnp.eye(6, dtype=system.dtype), pull)


def _plane(normals: Array, thickness: Array | float) -> Array:
    """Covariance of a small plane: thin along the normal, one across; round where there is none."""
    outer = normals[:, :, None] * normals[:, None, :]
    return jnp.eye(3, dtype=normals.dtype) - (1 - thickness) * outer


def _inverse_symmetric(m: Array) -> Array:
    """Inverses of (n, 3, 3) symmetric matrices by cofactors; ours are far from singular."""
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
