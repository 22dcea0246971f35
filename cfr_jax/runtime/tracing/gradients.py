"""Functions with a gradient written by hand that JAX can also differentiate in forward mode.

`jax.custom_vjp` has no forward mode: `jax.jacfwd` fails on all that it is part of. Here the
derivative of a function is one step, a linear map of the tangents. Forward mode runs it as JAX's
own derivative of the function, and reverse mode runs its transpose, which is the gradient written
by hand. Both are plain functions of JAX, so that derivatives of derivatives exist, too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.custom_derivatives import SymbolicZero
from jax.dtypes import float0
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir
from jax.interpreters.partial_eval import dce_jaxpr
from jaxtyping import Array

from cfr_jax.runtime.entries import ranks_may_differ

_Flat = Callable[..., Sequence[Any]]


def with_gradient(forward: Callable, backward: Callable, *arguments: Any) -> Any:
    """`forward(*arguments)[0]`, whose gradient is `backward`.

    `forward` answers the value and what else the gradient needs. `backward(arguments, needed,
    gradient)` answers the gradients with respect to the arguments, in their structure; None for one
    that has no gradient. What it answers has to be linear in `gradient`.
    """
    forward, backward = ranks_may_differ(forward), ranks_may_differ(backward)

    @jax.custom_jvp
    def valued(*arguments: Any) -> Any:
        return forward(*arguments)[0]

    def derivative(primals: tuple, tangents: tuple) -> tuple[Any, Any]:
        value, needed = _at_once(forward, primals)
        leaves, structure = jax.tree.flatten(primals)
        moving = jax.tree.leaves(tangents, is_leaf=lambda leaf: isinstance(leaf, SymbolicZero))
        moves = [not (isinstance(t, SymbolicZero) or t.dtype == float0) for t in moving]
        if not any(moves):
            return value, jax.tree.map(jax.numpy.zeros_like, value)
        kept, of_kept = jax.tree.flatten((primals, needed))
        values, of_value = jax.tree.flatten(value)

        def along(*given: Array) -> Sequence[Array]:
            """JAX's own derivative: from what is kept and the tangents to those of the value."""
            primals, _ = jax.tree.unflatten(of_kept, given[: len(kept)])
            fixed = jax.tree.leaves(primals)

            def of_moving(*some: Array) -> Sequence[Array]:
                rest = iter(some)
                every = [next(rest) if m else leaf for m, leaf in zip(moves, fixed, strict=True)]
                return jax.tree.leaves(forward(*jax.tree.unflatten(structure, every))[0])

            some = [leaf for m, leaf in zip(moves, fixed, strict=True) if m]
            return jax.jvp(of_moving, some, list(given[len(kept) :]))[1]

        def back(*given: Array) -> Sequence[Any]:
            """The gradient by hand: from what is kept and the gradient of the value to those of
            the arguments that move."""
            primals, needed = jax.tree.unflatten(of_kept, given[: len(kept)])
            gradient = jax.tree.unflatten(of_value, given[len(kept) :])
            found = zip(primals, backward(primals, needed, gradient), strict=True)
            every = [
                of_leaf
                for argument, own in found
                for of_leaf in (
                    [None] * len(jax.tree.leaves(argument)) if own is None else jax.tree.leaves(own)
                )
            ]
            return [own for m, own in zip(moves, every, strict=True) if m]

        tangent = _linear.bind(
            *kept,
            *(t for m, t in zip(moves, moving, strict=True) if m),
            run=along,
            transposed=back,
            kept=len(kept),
            answers=tuple(jax.typeof(leaf) for leaf in values),
        )
        return value, jax.tree.unflatten(of_value, tangent)

    valued.defjvp(derivative, symbolic_zeros=True)
    return valued(*arguments)


def _at_once(function: Callable, arguments: tuple) -> Any:
    """`function(*arguments)` as one step: reverse mode would sort what is in it into what is known
    and what is not, and keep whole blocks of loops although nothing in it is unknown."""
    program, answer = jax.make_jaxpr(function, return_shape=True)(*arguments)
    leaves = jax.tree.leaves(arguments)
    found = _linear.bind(
        *leaves,
        run=jaxpr_as_fun(program),
        transposed=None,
        kept=len(leaves),
        answers=tuple(program.out_avals),
    )
    return jax.tree.unflatten(jax.tree.structure(answer), found)


# A linear map of the operands that follow the first `kept`, of which there may be none: `run`
# computes it, `transposed` its transpose, from the same kept operands. `answers` are the types of
# what `run` returns.
_linear = Primitive("linear_by_hand")
_linear.multiple_results = True


@_linear.def_impl
def _impl(*operands: Any, run: _Flat, **_: Any) -> list[Any]:
    return list(run(*operands))


@_linear.def_abstract_eval
def _abstract(*_: Any, answers: tuple, **__: Any) -> tuple:
    return answers


def _needed_part(*operands: Any, run: _Flat, **_: Any) -> list[Any]:
    """`_impl` without what none of its results needs, such as gradients that nobody asked for."""
    program = jax.make_jaxpr(lambda *operands: list(run(*operands)))(*operands)
    some, _used = dce_jaxpr(program.jaxpr, [True] * len(program.out_avals), instantiate=True)
    return jaxpr_as_fun(ClosedJaxpr(some, program.consts))(*operands)


def _derivative(primals: Sequence, tangents: Sequence, **how: Any) -> tuple[list, list]:
    """Where nothing that is kept moves, the map itself; else JAX's derivative of `run`."""
    run, kept = how["run"], how["kept"]
    moves = [not (isinstance(t, ad.Zero) or t.dtype == float0) for t in tangents]
    if not any(moves[:kept]):
        moving = [ad.instantiate_zeros(t) for t in tangents[kept:]]
        return _linear.bind(*primals, **how), _linear.bind(*primals[:kept], *moving, **how)

    def of_moving(*some: Array) -> list[Array]:
        rest = iter(some)
        return list(run(*(next(rest) if m else p for m, p in zip(moves, primals, strict=True))))

    return jax.jvp(
        of_moving,
        [p for m, p in zip(moves, primals, strict=True) if m],
        [t for m, t in zip(moves, tangents, strict=True) if m],
    )


def _transpose(
    gradients: Sequence, *operands: Any, run: _Flat, transposed: _Flat, kept: int, answers: tuple
) -> list[Any]:
    given = [
        jax.numpy.zeros(answer.shape, answer.dtype) if isinstance(g, ad.Zero) else g
        for g, answer in zip(gradients, answers, strict=True)
    ]
    wanted = [ad.is_undefined_primal(operand) for operand in operands[kept:]]
    found = _linear.bind(
        *operands[:kept],
        *given,
        run=transposed,
        transposed=run,
        kept=kept,
        answers=tuple(
            operand.aval if open_ else jax.typeof(operand)
            for open_, operand in zip(wanted, operands[kept:], strict=True)
        ),
    )
    return [None] * kept + [g if open_ else None for open_, g in zip(wanted, found, strict=True)]


def _batched(operands: Sequence, axes: Sequence, **how: Any) -> tuple[list, list[int]]:
    size = next(
        operand.shape[axis]
        for operand, axis in zip(operands, axes, strict=True)
        if axis is not None
    )
    kept, placed, over = how["kept"], [], []
    for number, (operand, axis) in enumerate(zip(operands, axes, strict=True)):
        if axis is not None:
            operand = jax.numpy.moveaxis(operand, axis, 0)
        elif number >= kept:  # what is linear is mapped over as a whole: so is what answers it
            operand = jax.numpy.broadcast_to(operand, (size, *operand.shape))
        placed.append(operand)
        over.append(0 if axis is not None or number >= kept else None)
    fixed = tuple(over[:kept])
    found = _linear.bind(
        *placed,
        run=_mapped(how["run"], fixed),
        transposed=how["transposed"] and _mapped(how["transposed"], fixed),
        kept=kept,
        answers=tuple(answer.update(shape=(size, *answer.shape)) for answer in how["answers"]),
    )
    return found, [0] * len(found)


def _mapped(run: _Flat, of_kept: tuple[int | None, ...]) -> _Flat:
    def mapped(*operands: Array) -> Sequence[Array]:
        axes = of_kept + (0,) * (len(operands) - len(of_kept))
        # a list, as `vmap` takes only what it can map as what it answers
        return jax.vmap(lambda *one: list(run(*one)), in_axes=axes)(*operands)

    return mapped


ad.primitive_jvps[_linear] = _derivative
ad.primitive_transposes[_linear] = _transpose
batching.primitive_batchers[_linear] = _batched
mlir.register_lowering(_linear, mlir.lower_fun(_needed_part, multiple_results=True))
