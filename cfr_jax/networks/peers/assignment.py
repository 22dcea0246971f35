"""One-to-one correspondences: the true ones that RGM learns, and those made of a soft assignment.

An assignment is a block (n, m) of zeros and ones, with at most one of them in a row or column.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax, nn
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from cfr_jax.geometry import rigid
from cfr_jax.geometry.closest import squares
from cfr_jax.networks.inputs import Cloud, moved_by

_CLOSE, _WIDE = 0.05, 0.1  # how far partners may lie apart, in the unit sphere
# Entries that the host is handed as one array, 64 KiB. JAX copies a larger one on a thread of the
# device, and where a CPU is several devices, those wait for the host, and the host for them.
_HANDED = 1 << 14


def assign(log_plan: Float[Array, "n m"], least: float) -> Float[Array, "n m"]:
    """The assignment of the largest sum, among rows and columns that sum to more than `least`.

    The host finds it, by scipy's form of the Hungarian method.
    """
    plan = lax.stop_gradient(jnp.exp(log_plan))
    n, m = plan.shape
    rows = max(1, _HANDED // m)
    blocks = [plan[start : start + rows].astype(jnp.float32) for start in range(0, n, rows)]
    partners = jax.ShapeDtypeStruct((n,), jnp.int32)
    found = jax.pure_callback(_partners, partners, least, *blocks, vmap_method="sequential")
    return nn.one_hot(found, m, dtype=plan.dtype)  # of -1, a row of zeros


def _partners(least: ArrayLike, *blocks: ArrayLike) -> np.ndarray:
    """The column of each row, or -1."""
    from scipy.optimize import linear_sum_assignment

    plan = np.concatenate([np.asarray(block) for block in blocks])
    rows = np.flatnonzero(plan.sum(axis=1) > least)
    columns = np.flatnonzero(plan.sum(axis=0) > least)
    found = np.full(len(plan), -1, np.int32)
    chosen = linear_sum_assignment(plan[np.ix_(rows, columns)], maximize=True)
    found[rows[chosen[0]]] = columns[chosen[1]]
    return found


def in_rounds(
    match: Callable[[Cloud, Cloud], Float[Array, "n m"]], source: Cloud, target: Cloud, rounds: int
) -> Float[Array, "n m"]:
    """The assignment of the last of some rounds, each from where the last one put the source."""

    def once(motion: Array, _: None) -> tuple[Array, Array]:
        moved = moved_by(motion, source)
        found = match(moved, target)
        return rigid.compose(motion_of(found, moved, target), motion), found

    start = jnp.eye(4, dtype=source.points.dtype)
    return lax.scan(once, start, length=rounds)[1][-1]


def motion_of(plan: Float[Array, "n m"], source: Cloud, target: Cloud) -> Float[Array, "4 4"]:
    """The motion that an assignment asks for, hard or soft: a point weighs as much as its row.

    Where none has a partner, the identity.
    """
    weights = jnp.sum(plan, axis=1)
    sums = jnp.matmul(plan, target.points, precision=lax.Precision.HIGHEST)
    return rigid.fit_rigid(source.points, sums / jnp.maximum(weights, 1e-5)[:, None], weights)


def true_assignment(
    source: Cloud, target: Cloud, truth: Float[Array, "4 4"]
) -> Float[Array, "n m"]:
    """Which points lie on each other under the true motion, source onto target.

    As published. First, mutual nearest points closer than 0.05. Then points whose nearest one is
    still free and as close, those of the source first; where several ask for the same, the closest
    of them has it. Last, mutual nearest points closer than 0.1 among those that are left.
    """
    square = squares(rigid.apply(truth, source.points)[:, None], target.points)
    for mask, axis in ((source.mask, 1), (target.mask, 0)):
        if mask is not None:
            square = jnp.where(jnp.expand_dims(mask, axis), square, jnp.inf)
    near = square < _CLOSE**2
    of_rows, of_columns = _least(square, 1), _least(square, 0)
    found = of_rows & of_columns & near
    for own, axis in ((of_rows, 0), (of_columns, 1)):
        asked = jnp.where(own & near & _free(found), square, jnp.inf)
        found |= _least(asked, axis) & (asked < jnp.inf)
    left = jnp.where(_free(found), square, jnp.inf)
    found |= _least(left, 0) & _least(left, 1) & (left < _WIDE**2)
    return found.astype(source.points.dtype)


def _least(square: Float[Array, "n m"], axis: int) -> Bool[Array, "n m"]:
    """The least entry along an axis, one of them where several are."""
    first = jnp.expand_dims(jnp.argmin(square, axis=axis), axis)
    place = lax.broadcasted_iota(first.dtype, square.shape, axis)
    return place == first


def _free(found: Bool[Array, "n m"]) -> Bool[Array, "n m"]:
    """Whose point and whose partner both have none yet."""
    rows, columns = (jnp.any(found, axis=axis, keepdims=True) for axis in (1, 0))
    return ~rows & ~columns
