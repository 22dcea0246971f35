"""The forms of the match with a hand-written gradient, and the choice between them by platform.

Their gradients need little memory. All forms leave the same trace, so a
program that is not yet lowered can hold one form for CPUs and another for other platforms.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from cfr_jax.networks.sinkhorn import scaling, streamed
from cfr_jax.networks.sinkhorn.affinity import Affinity, Match
from cfr_jax.runtime.tracing.gradients import with_gradient

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
    there, back = (
        functools.partial(way, passes, (on_cpu, elsewhere)) for way in (_forward, _backward)
    )
    return with_gradient(there, back, affinity, points, (of_source, of_target))


def _forward(
    passes: int, ways: tuple[Way, Way], affinity: Affinity, points: Array, masks: _Masks
) -> tuple[Match, scaling.Trace]:
    def run(
        way: Way, affinity: Affinity, points: Array, masks: _Masks
    ) -> tuple[Match, scaling.Trace]:
        if way.kind == "streamed":
            return streamed.forward(affinity, points, masks, passes=passes, rows=way.rows)
        return scaling.forward(scaling.Stored(affinity, masks), points, passes)

    return _by_platform(run, ways, affinity, points, masks)


def _backward(
    passes: int,
    ways: tuple[Way, Way],
    arguments: tuple[Affinity, Array, _Masks],
    trace: scaling.Trace,
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

    return *_by_platform(run, ways, *arguments, trace, gradient), None


def _by_platform(run: Callable[..., Any], ways: tuple[Way, Way], *arguments: Any) -> Any:
    on_cpu, elsewhere = (functools.partial(run, way) for way in ways)
    if ways[0] == ways[1]:
        return on_cpu(*arguments)
    return lax.platform_dependent(*arguments, cpu=on_cpu, default=elsewhere)
