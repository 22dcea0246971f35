"""Small symmetric matrices: all eigenvectors of a 3x3 matrix (for normals), the leading eigenvector
of a 4x4 matrix (for rotations), and the solution of a 6x6 system (for refinement steps).

`jnp.linalg` calls solvers made for large matrices: on a GPU, a batch of 3x3 matrices takes longer
there than the whole network. Cyclic Jacobi (Golub & Van Loan, ch. 8.5) never fails and needs no
branch. Written out by components, it is plain vector arithmetic over a batch. A single eigenvector
needs less work: the power method, with powers computed by repeated squaring.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

# Jacobi converges quadratically. For random matrices, rank-deficient ones, and ones with repeated
# eigenvalues, the fifth sweep no longer changes a float32 result (tests/geometry/test_eigen.py).
SWEEPS = 5
# The power 2^20 separates eigenvalues that differ by a millionth of the largest. Smaller
# differences have no meaning in float32.
SQUARINGS = 20
_HIGHEST = lax.Precision.HIGHEST
_Entries = dict[tuple[int, int], Array]


@functools.partial(jax.jit, static_argnames=("sweeps",))  # traces its many scalars only once
def symmetric_eigen(
    matrix: Float[Array, "d d"], *, sweeps: int = SWEEPS
) -> tuple[Float[Array, " d"], Float[Array, "d d"]]:
    """Eigenvalues, in no particular order, and their unit eigenvectors as columns.

    Not meant to be differentiated: eigenvectors have no finite derivative where eigenvalues
    coincide. Callers define the derivative of what they compute from them.
    """
    d = matrix.shape[0]
    entries = {(i, j): matrix[i, j] for i in range(d) for j in range(i, d)}
    one, zero = jnp.ones((), matrix.dtype), jnp.zeros((), matrix.dtype)
    vectors = {(i, j): one if i == j else zero for i in range(d) for j in range(d)}
    entries, vectors = _repeated(_sweep, sweeps, (entries, vectors))
    values = jnp.stack([entries[i, i] for i in range(d)])
    return values, jnp.stack([vectors[i, j] for i in range(d) for j in range(d)]).reshape(d, d)


@functools.partial(jax.jit, static_argnames=("squarings",))
def leading_eigenvector(
    matrix: Float[Array, "d d"], *, squarings: int = SQUARINGS
) -> Float[Array, " d"]:
    """An eigenvector for the largest eigenvalue of a symmetric matrix with trace zero.

    Its length is arbitrary but not zero. If several eigenvalues are the largest, it is a vector of
    their common eigenspace; for the zero matrix it is the first axis. `squarings` is even. Like
    `symmetric_eigen`, not meant to be differentiated.
    """
    identity = jnp.eye(len(matrix), dtype=matrix.dtype)
    size = jnp.sqrt(jnp.sum(matrix * matrix))
    # Because the eigenvalues sum to zero, adding half the norm makes the largest one exceed the
    # absolute value of the smallest, so that it also dominates the powers.
    small = matrix / jnp.where(size > 0, size, 1)
    lifted = jnp.where(size > 0, small + identity / 2, jnp.diag(identity[0]))
    power = _repeated(_squared_twice, squarings // 2, lifted)
    vector = power[jnp.argmax(jnp.diagonal(power))]
    for _ in range(2):  # multiplying by the matrix itself reduces the squarings' rounding errors
        vector = jnp.sum(lifted * vector, axis=1)
    return vector


@jax.jit
def solve_positive(matrix: Float[Array, "d d"], right: Float[Array, " d"]) -> Float[Array, " d"]:
    """Solves matrix x = right for a symmetric positive definite matrix.

    Gauss-Jordan elimination. No pivot search is needed, because all pivots are positive.
    """
    rows = jnp.concatenate([matrix, right[:, None]], axis=1)
    return _repeated(_eliminate, len(matrix), rows)[:, -1]


def _eliminate(k: Array | int, rows: Float[Array, "d e"]) -> Float[Array, "d e"]:
    pivot = rows[k] / rows[k, k]
    column = lax.dynamic_slice_in_dim(rows, k, 1, axis=1)
    own = jnp.arange(len(rows))[:, None] == k
    return jnp.where(own, pivot, rows - column * pivot)


def _repeated(step: Callable[[Any, Any], Any], count: int, state: Any) -> Any:
    """Applies `step(i, state)` for i = 0 to `count` - 1.

    Accelerators get the unrolled steps: in a loop, every carried number would be copied by a kernel
    of its own. On a CPU a loop compiles faster.
    """

    def looped(state: Any) -> Any:
        return lax.fori_loop(0, count, step, state)

    def written_out(state: Any) -> Any:
        for i in range(count):
            state = step(i, state)
        return state

    return lax.platform_dependent(state, cpu=looped, default=written_out)


@jax.jit
def _squared_twice(_: Any, power: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """The fourth power, its trace one again: a single kernel of an accelerator, as two squarings
    with a trace each would be two."""
    square = jnp.sum(power[:, :, None] * power[None, :, :], axis=1)
    fourth = jnp.sum(square[:, :, None] * square[None, :, :], axis=1)
    return fourth / jnp.sum(square * square)  # it is symmetric


@jax.jit
def _sweep(_: Any, state: tuple[_Entries, _Entries]) -> tuple[_Entries, _Entries]:
    entries, vectors = state
    d = max(row for row, _ in vectors) + 1
    for p in range(d):
        for q in range(p + 1, d):
            entries, vectors = _turn(entries, vectors, p, q, d)
    return entries, vectors


def _turn(
    entries: _Entries, vectors: _Entries, p: int, q: int, d: int
) -> tuple[_Entries, _Entries]:
    """One Jacobi rotation, which makes entry (p, q) zero."""
    off, gap = entries[p, q], entries[q, q] - entries[p, p]
    # the tangent of the smaller angle that satisfies tan(2 angle) = 2 off / gap
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


def least_direction(covariance: Float[Array, "3 3"]) -> Float[Array, " 3"]:
    """Unit eigenvector for the smallest eigenvalue of a symmetric matrix; its sign is arbitrary.

    The derivative is zero in undetermined directions: where the two smallest eigenvalues differ by
    at most 1e-5 of the matrix's largest entry (a line, a ball). The limit is relative, so it holds
    at every scale.
    """
    return _least_and_rest(covariance / size_of(covariance))[0]


@jax.custom_jvp
def _least_and_rest(matrix: Float[Array, "3 3"]) -> tuple[Float[Array, " 3"], Float[Array, "3 3"]]:
    """The eigenvector n for the smallest eigenvalue l, and the pseudo-inverse of matrix - l I,
    which is all that derivatives of n of any order need."""
    values, vectors = symmetric_eigen(matrix)
    gap = values - jnp.min(values)
    return vectors[:, jnp.argmin(values)], _inverse(gap, vectors)


@_least_and_rest.defjvp
def _least_and_rest_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[tuple, tuple]:
    (matrix,), (tangent,) = primals, tangents
    least, inverse = _least_and_rest(matrix)
    change = jnp.matmul(tangent, least, precision=_HIGHEST)
    of_least = -jnp.matmul(inverse, change, precision=_HIGHEST)
    # what is inverted has the null space n, and whatever else is not determined
    identity = jnp.eye(3, dtype=matrix.dtype)
    smallest = jnp.sum(least * jnp.matmul(matrix, least, precision=_HIGHEST))
    inverted = matrix - smallest * identity
    rest = identity - jnp.matmul(inverse, inverted, precision=_HIGHEST)
    shifted = tangent - jnp.sum(least * change) * identity
    return (least, inverse), (of_least, _change_of_inverse(inverse, rest, shifted))


@jax.custom_jvp
def pseudo_inverse(matrix: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """The pseudo-inverse of a symmetric positive semidefinite matrix with entries of about one.

    Eigenvalues of at most 1e-5 count as zero. There are derivatives of every order; in directions
    that do not count they are those of a matrix whose rank stays as it is.
    """
    return _inverse(*symmetric_eigen(matrix))


@pseudo_inverse.defjvp
def _pseudo_inverse_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (matrix,), (tangent,) = primals, tangents
    inverse = pseudo_inverse(matrix)
    identity = jnp.eye(len(matrix), dtype=matrix.dtype)
    rest = identity - jnp.matmul(inverse, matrix, precision=_HIGHEST)
    return inverse, _change_of_inverse(inverse, rest, tangent)


def _change_of_inverse(inverse: Array, rest: Array, change: Array) -> Array:
    """The derivative of a symmetric pseudo-inverse for a `change` of its matrix (Golub & Pereyra,
    1973); `rest` projects onto the null space."""

    def product(*factors: Array) -> Array:
        return functools.reduce(functools.partial(jnp.matmul, precision=_HIGHEST), factors)

    twice = product(inverse, inverse, change, rest)
    return twice + twice.T - product(inverse, change, inverse)


def _inverse(values: Float[Array, " d"], vectors: Float[Array, "d d"]) -> Float[Array, "d d"]:
    counts = values > 1e-5
    inverse = jnp.where(counts, 1 / jnp.where(counts, values, 1), 0)
    return jnp.matmul(vectors * inverse, vectors.T, precision=_HIGHEST)


def size_of(values: Float[Array, "*shape"]) -> Float[Array, ""]:
    """The largest absolute value, or one if all are zero; a constant to derivatives."""
    largest = jnp.max(jnp.abs(values), initial=0)
    return lax.stop_gradient(jnp.where(largest > 0, largest, 1))
