"""The block inside a kernel (Pallas, Triton): features in, sums out, no n x m array anywhere.

Each program of the kernel has some rows and goes over all columns, tile by tile: it computes the
product of the features and the exponential, and adds to the sums at once. Column sums use the same
kernel with the clouds exchanged, so a pass computes the block twice. On paper that pays off only if
the block does not fit in the device's memory: an H200 reads 12,000^2 stored numbers in 0.13 ms, and
computes them by float32 products in 0.5 ms or more (2 n m d = 28 GFLOP, 60 TFLOP/s). So `match`
never chooses this form by itself.

On anything but a GPU the kernels are interpreted, which is slow and gives the same answers. JAX
0.11 warns that it will drop the Triton backend of Pallas.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as gpu
from jaxtyping import Array, Bool, Float

from cfr_jax.networks.sinkhorn.affinity import Affinity, log_affinity
from cfr_jax.networks.sinkhorn.scaling import Spent

_Ref = Any  # an array inside a kernel; Pallas has no public class for it

_CHUNK = 32  # channels of one product; the sizes of arrays in a kernel must be powers of two


class Fused:
    """A `scaling.Block` that is never stored; tiles are `rows` by `rows`."""

    def __init__(
        self,
        affinity: Affinity,
        masks: tuple[Bool[Array, " n"], Bool[Array, " m"]],
        shift: Float[Array, " n"] | None = None,
        *,
        rows: int,
    ):
        self.affinity: Affinity = affinity
        self.size: int = rows
        # subtracted from the log affinities; infinite where masked
        self.less: list[Array] = [
            jnp.where(mask, 0, jnp.inf).astype(affinity.beta.dtype) for mask in masks
        ]
        if shift is None:
            shift = jnp.maximum(self._run(_highest, (), flip=False, sums=1)[0][:, 0], 0)
        self.shift: Array = shift
        self.less[0] += shift

    def rows(self, right: Float[Array, "m c"]) -> Float[Array, "n c"]:
        return self._run(_sums, (None, right.T), flip=False, sums=right.shape[1])[0]

    def columns(self, left: Float[Array, "n c"]) -> Float[Array, "m c"]:
        return self._run(_sums, (None, left.T), flip=True, sums=left.shape[1])[0]

    def spend(self, left: Float[Array, "n r"], right: Float[Array, "m r"]) -> Spent:
        left, right = (_padded(part, 1, _CHUNK) for part in (left, right))
        width = self.affinity.source.shape[1]
        source, sums = self._run(_spent, (left, right), flip=False, sums=width, more=2)
        target, _ = self._run(_spent, (right, left), flip=True, sums=width, more=2)
        return Spent(source, target, jnp.sum(sums[:, 0]), jnp.sum(sums[:, 1]))

    def _run(
        self,
        kernel: Callable[..., None],
        others: tuple[Array | None, ...],
        *,
        flip: bool,
        sums: int,
        more: int = 0,
    ) -> tuple[Array, ...]:
        """Runs a kernel over the rows; with `flip`, the clouds are exchanged.

        `others` holds an array for the rows and one for the columns, if there are any. Returns
        arrays (rows, sums) and, if `more` is not 0, (rows, more).
        """
        clouds = [self.affinity.source, self.affinity.target]
        here, there = reversed(clouds) if flip else clouds
        less = self.less[::-1] if flip else self.less
        annealing = jnp.stack([self.affinity.beta, self.affinity.alpha])
        return _call(kernel, self.size, sums, more, annealing, here, there, *less, *others)


def _call(
    kernel: Callable[..., None],
    size: int,
    sums: int,
    more: int,
    annealing: Array,
    here: Array,
    there: Array,
    less_here: Array,
    less_there: Array,
    *others: Array | None,
) -> tuple[Array, ...]:
    n, wide = here.shape[0], kernel is _spent
    here, there = (_padded(_padded(part, 0, size), 1, _CHUNK) for part in (here, there))
    less = [_padded(part, 0, size, jnp.inf) for part in (less_here, less_there)]
    given = [annealing, here, less[0], there, less[1]]
    specs = [
        _whole(annealing),
        pl.BlockSpec((size, here.shape[1]), lambda i: (i, 0)),
        pl.BlockSpec((size,), lambda i: (i,)),
        _whole(there),
        _whole(less[1]),
    ]
    of_rows, of_columns = others or (None, None)
    if of_rows is not None:
        given.append(_padded(of_rows, 0, size))
        specs.append(pl.BlockSpec((size, given[-1].shape[1]), lambda i: (i, 0)))
    if of_columns is not None:
        given.append(_padded(of_columns, 0 if wide else 1, size))
        specs.append(_whole(given[-1]))
    # widths in a kernel must be powers of two; `_sums` writes its sums one at a time instead
    widths = [here.shape[1], more] if wide else [sums]
    shapes = [(here.shape[0], width) for width in widths]

    def run(*given: Array, interpret: bool) -> Sequence[Array]:
        return pl.pallas_call(
            functools.partial(kernel, tiles=there.shape[0] // size),
            out_shape=[jax.ShapeDtypeStruct(shape, here.dtype) for shape in shapes],
            grid=(here.shape[0] // size,),
            in_specs=specs,
            out_specs=[pl.BlockSpec((size, width), lambda i: (i, 0)) for width in widths],
            compiler_params=gpu.CompilerParams(num_warps=4, num_stages=2),
            interpret=interpret,
        )(*given)

    compiled, interpreted = (functools.partial(run, interpret=flag) for flag in (False, True))
    found = lax.platform_dependent(*given, cuda=compiled, rocm=compiled, default=interpreted)
    first = found[0][:n, :sums]
    return (first, found[1][:n]) if wide else (first,)


def _padded(part: Array, axis: int, size: int, fill: float = 0.0) -> Array:
    pad = [(0, 0)] * part.ndim
    pad[axis] = (0, -part.shape[axis] % size)
    return jnp.pad(part, pad, constant_values=fill)


def _whole(part: Array) -> pl.BlockSpec:
    return pl.BlockSpec(part.shape, lambda i: (0,) * part.ndim)


def _logs(
    annealing: _Ref, here: _Ref, less_here: _Ref, there: _Ref, less_there: _Ref, tile: Array
) -> tuple[Array, Array, pl.Slice | slice]:
    """For this program's rows and one tile of columns: the log affinities less their offsets,
    |f - g|^2, and the slice of those columns."""
    size = less_here.shape[0]
    columns = pl.ds(tile * size, size)
    products = (
        _dot(here[:, pl.ds(start, _CHUNK)], there[columns, pl.ds(start, _CHUNK)].T)
        for start in range(0, here.shape[1], _CHUNK)
    )
    square = 2 - 2 * functools.reduce(jnp.add, products)
    logs = log_affinity(square, annealing[0], annealing[1])
    return logs - less_here[:][:, None] - less_there[columns][None], square, columns


def _dot(a: Array, b: Array) -> Array:
    return jnp.dot(a, b, precision=lax.Precision.HIGHEST)


def _highest(
    annealing: _Ref,
    here: _Ref,
    less_here: _Ref,
    there: _Ref,
    less_there: _Ref,
    out: _Ref,
    *,
    tiles: int,
) -> None:
    def step(tile: Array, high: Array) -> Array:
        logs, *_ = _logs(annealing, here, less_here, there, less_there, tile)
        return jnp.maximum(high, jnp.max(logs, axis=1))

    lowest = jnp.full(less_here.shape, -jnp.inf, here.dtype)
    out[:, 0] = lax.fori_loop(0, tiles, step, lowest)


def _sums(
    annealing: _Ref,
    here: _Ref,
    less_here: _Ref,
    there: _Ref,
    less_there: _Ref,
    weights: _Ref,
    out: _Ref,
    *,
    tiles: int,
) -> None:
    count = weights.shape[0]

    def step(tile: Array, sums: list[Array]) -> list[Array]:
        logs, _, columns = _logs(annealing, here, less_here, there, less_there, tile)
        block = jnp.exp(logs)
        return [
            total + jnp.sum(block * weights[i, columns][None], axis=1)
            for i, total in enumerate(sums)
        ]

    nothing = jnp.zeros(less_here.shape, here.dtype)
    for i, total in enumerate(lax.fori_loop(0, tiles, step, [nothing] * count)):
        out[:, i] = total


def _spent(
    annealing: _Ref,
    here: _Ref,
    less_here: _Ref,
    there: _Ref,
    less_there: _Ref,
    left: _Ref,
    right: _Ref,
    of_here: _Ref,
    of_annealing: _Ref,
    *,
    tiles: int,
) -> None:
    starts = range(0, here.shape[1], _CHUNK)

    def step(
        tile: Array, state: tuple[list[Array], Array, Array]
    ) -> tuple[list[Array], Array, Array]:
        of_features, of_beta, of_alpha = state
        logs, square, columns = _logs(annealing, here, less_here, there, less_there, tile)
        thin = sum(
            _dot(left[:, pl.ds(start, _CHUNK)], right[columns, pl.ds(start, _CHUNK)].T)
            for start in range(0, left.shape[1], _CHUNK)
        )
        share = jnp.exp(logs) * thin
        of_features = [
            total + _dot(share, there[columns, pl.ds(start, _CHUNK)])
            for total, start in zip(of_features, starts, strict=True)
        ]
        of_beta += jnp.sum(share * (annealing[1] - square), axis=1)
        return of_features, of_beta, of_alpha + jnp.sum(share, axis=1)

    size, dtype = less_here.shape[0], here.dtype
    nothing = jnp.zeros(size, dtype)
    zeros = [jnp.zeros((size, _CHUNK), dtype) for _ in starts], nothing, nothing
    of_features, of_beta, of_alpha = lax.fori_loop(0, tiles, step, zeros)
    for total, start in zip(of_features, starts, strict=True):
        of_here[:, pl.ds(start, _CHUNK)] = total
    of_annealing[:, 0] = of_beta
    of_annealing[:, 1] = of_alpha
