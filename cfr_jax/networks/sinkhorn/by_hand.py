"""The forms of the match with a hand-written gradient, and the choice between them by platform.

Their gradients need little memory and can be taken once. All forms leave the same trace, so a
program that is not yet lowered can hold one form for CPUs and another for other platforms.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from cfr_jax.networks.sinkhorn import scaling, streamed
from cfr_jax.networks.sinkhorn.affinity import Affinity, Match

_Masks = tuple[Array, Array]


class Way(NamedTuple):
    """How a platform computes the match."""

    kind: Literal["stored", "streamed"]
    """Stored in memory, or streamed in blocks of whole rows."""
    rows: int
    """Rows of a streamed block; not used if stored."""


def match_by_hand(
    affinity: Affinity,
    points: Float[Array, "m 3"],
    *,
    passes: int,
    on_cpu: Way,
    elsewhere: Way,
    source_mask: Bool[Array, " n"] | None = None,
    target_mask: Bool[Array, " m"] | None = None,
) -> Match:
    """`match`, as suits the platform that the program is lowered for."""
    sizes = affinity.source.shape[0], affinity.target.shape[0]
    of_source, of_target = (
        jnp.ones(size, bool) if mask is None else mask
        for mask, size in zip((source_mask, target_mask), sizes, strict=True)
    )
    return _match(affinity, points, (of_source, of_target), passes, (on_cpu, elsewhere))


@functools.partial(jax.custom_vjp, nondiff_argnums=(3, 4))
def _match(
    affinity: Affinity, points: Array, masks: _Masks, passes: int, ways: tuple[Way, Way]
) -> Match:
    return _forward(affinity, points, masks, passes, ways)[0]


def _forward(
    affinity: Affinity, points: Array, masks: _Masks, passes: int, ways: tuple[Way, Way]
) -> tuple[Match, tuple[Affinity, Array, _Masks, scaling.Trace]]:
    def run(
        way: Way, affinity: Affinity, points: Array, masks: _Masks
    ) -> tuple[Match, scaling.Trace]:
        if way.kind == "streamed":
            return streamed.forward(affinity, points, masks, passes=passes, rows=way.rows)
        return scaling.forward(scaling.Stored(affinity, masks), points, passes)

    found, trace = _by_platform(run, ways, affinity, points, masks)
    return found, (affinity, points, masks, trace)


def _backward(
    passes: int,
    ways: tuple[Way, Way],
    residuals: tuple[Affinity, Array, _Masks, scaling.Trace],
    gradient: Match,
) -> tuple[Affinity, Array, None]:
    def run(
        way: Way,
        affinity: Affinity,
        points: Array,
        masks: _Masks,
        trace: scaling.Trace,
        gradient: Match,
    ) -> tuple[Affinity, Array]:
        if way.kind == "streamed":
            return streamed.backward(
                affinity, points, masks, trace, gradient, passes=passes, rows=way.rows
            )
        block = scaling.Stored(affinity, masks, trace.shift)
        return scaling.backward(block, affinity, points, trace, gradient)

    return *_by_platform(run, ways, *residuals, gradient), None


_match.defvjp(_forward, _backward)


def _by_platform(run: Callable[..., Any], ways: tuple[Way, Way], *arguments: Any) -> Any:
    on_cpu, elsewhere = (functools.partial(run, way) for way in ways)
    if ways[0] == ways[1]:
        return on_cpu(*arguments)
    return lax.platform_dependent(*arguments, cpu=on_cpu, default=elsewhere)
