"""Eigenvectors of small symmetric matrices, for rotations (4x4) and normals (3x3).

`jnp.linalg.eigh` calls a solver made for large matrices: a batch of 3x3 takes longer there than the
whole network on a GPU. Cyclic Jacobi (Golub & Van Loan, ch. 8.5) never fails, needs no branch, and
written out by components it is plain vector arithmetic over a batch.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

# Converges quadratically: on random matrices, on rank-deficient ones and on ones with repeated
# eigenvalues the fifth sweep no longer changes a float32 result (tests/test_eigen.py).
_SWEEPS = 5
_HIGHEST = lax.Precision.HIGHEST


@jax.jit  # so that its many scalars are traced once
def symmetric_eigen(
    matrix: Float[Array, "d d"],
) -> tuple[Float[Array, " d"], Float[Array, "d d"]]:
    """Eigenvalues, in no order, and their unit eigenvectors as columns.

    Not meant to be differentiated: eigenvectors have no finite derivative where eigenvalues meet.
    Callers state the derivative of what they make of them.
    """
    d = matrix.shape[0]
    entries = {(i, j): matrix[i, j] for i in range(d) for j in range(i, d)}
    one, zero = jnp.ones((), matrix.dtype), jnp.zeros((), matrix.dtype)
    vectors = {(i, j): one if i == j else zero for i in range(d) for j in range(d)}

    def sweep(_, state):
        entries, vectors = state
        for p in range(d):
            for q in range(p + 1, d):
                entries, vectors = _turn(entries, vectors, p, q, d)
        return entries, vectors

    entries, vectors = lax.fori_loop(0, _SWEEPS, sweep, (entries, vectors))
    values = jnp.stack([entries[i, i] for i in range(d)])
    return values, jnp.stack([vectors[i, j] for i in range(d) for j in range(d)]).reshape(d, d)


def _turn(entries, vectors, p, q, d):
    """One Jacobi rotation, which makes entry (p, q) zero."""
    off, gap = entries[p, q], entries[q, q] - entries[p, p]
    # tan of the smaller angle with tan(2 angle) = 2 off / gap
    reach = jnp.abs(gap) + jnp.sqrt(gap * gap + 4 * off * off)
    tangent = 2 * off * jnp.where(gap < 0, -1, 1) / jnp.where(reach > 0, reach, 1)
    cosine = lax.rsqrt(1 + tangent * tangent)
    sine = tangent * cosine
    turned = dict(entries)
    turned[p, p] = entries[p, p] - tangent * off
    turned[q, q] = entries[q, q] + tangent * off
    turned[p, q] = jnp.zeros_like(off)
    for r in set(range(d)) - {p, q}:
        rp, rq = (min(r, p), max(r, p)), (min(r, q), max(r, q))
        turned[rp] = cosine * entries[rp] - sine * entries[rq]
        turned[rq] = sine * entries[rp] + cosine * entries[rq]
    basis = dict(vectors)
    for r in range(d):
        basis[r, p] = cosine * vectors[r, p] - sine * vectors[r, q]
        basis[r, q] = sine * vectors[r, p] + cosine * vectors[r, q]
    return turned, basis


@jax.custom_jvp
def least_direction(covariance: Float[Array, "3 3"]) -> Float[Array, " 3"]:
    """Unit eigenvector of the smallest eigenvalue of a symmetric matrix; its sign is arbitrary.

    The derivative is zero in the directions that nothing determines: where the two smallest
    eigenvalues agree to 1e-5 of the largest (a line, a ball), relative, so at every scale.
    """
    values, vectors = symmetric_eigen(_unit_scale(covariance)[0])
    return vectors[:, jnp.argmin(values)]


@least_direction.defjvp
def _least_direction_jvp(primals, tangents):
    (covariance,), (tangent,) = primals, tangents
    scaled, scale = _unit_scale(covariance)
    values, vectors = symmetric_eigen(scaled)
    least = vectors[:, jnp.argmin(values)]
    gap = values - jnp.min(values)
    apart = gap > 1e-5
    change = jnp.matmul(tangent / scale, least, precision=_HIGHEST)
    pull = jnp.matmul(vectors.T, change, precision=_HIGHEST)
    pull = jnp.where(apart, pull / jnp.where(apart, gap, 1), 0)
    return least, -jnp.matmul(vectors, pull, precision=_HIGHEST)


def _unit_scale(matrix):
    largest = jnp.max(jnp.abs(matrix))
    scale = lax.stop_gradient(jnp.where(largest > 0, largest, 1))
    return matrix / scale, scale
