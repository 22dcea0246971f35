"""Prepares a pair whose source is multiplied by a factor of scale, given or estimated."""

from __future__ import annotations

import dataclasses
from numbers import Real
from typing import Any, Literal

from cfr_jax.alignment import doubts
from cfr_jax.alignment.planning import Initial, Plan, planned, read_clouds
from cfr_jax.alignment.scaling.estimating import estimated, multiplied
from cfr_jax.networks.record import Params

# What the option `scale` of `align` takes.
Scale = float | Literal["auto"]

_LARGEST = 1e12  # no two units differ by more, and coordinates stay numbers


def planned_at_scale(
    params: Params, source: Any, target: Any, *, scale: Scale, initial: Initial, **options: Any
) -> Plan:
    """The plan for a source multiplied by `scale`, or, for "auto", by an estimated factor.

    `options` are those of `planned`. An estimate also finds a motion. It becomes the start if
    `initial` is None. Raises ValueError like `planned`, and for a `scale` that is neither "auto"
    nor a positive number.
    """
    factor = checked_scale(scale, initial)
    if factor == 1:
        return planned(source, target, initial=initial, **options)
    clouds = read_clouds(source, target)
    if factor is not None:
        return _planned(*clouds, factor, None, initial=initial, **options)
    settings = {name: options[name] for name in ("max_points", "seed", "search") if name in options}
    found = estimated(params, *clouds, everywhere=initial == "global", **settings)
    if initial == "auto" and not doubts.trusted(found.confidence):
        found = estimated(params, *clouds, everywhere=True, **settings)
    start = found.motion if initial is None else initial
    return _planned(*clouds, found.factor, found.confidence, initial=start, **options)


def checked_scale(scale: Any, initial: Any) -> float | None:
    """A given factor as a float; None for one that is to be estimated. Raises ValueError for
    anything else, and for motions from which to start with an unknown factor."""
    if isinstance(scale, str) and scale == "auto":
        if initial is not None and not isinstance(initial, str):
            raise ValueError(
                'scale: got "auto" with initial motions, which move the scaled source; wanted a '
                "number, or no initial motion"
            )
        return None
    usable = isinstance(scale, Real) and not isinstance(scale, bool)
    if not usable or not 1 / _LARGEST <= float(scale) <= _LARGEST:  # NaN is in no range
        raise ValueError(
            f'scale: got {scale!r}, wanted "auto" or a number from {1 / _LARGEST:g} to {_LARGEST:g}'
        )
    return float(scale)


def _planned(
    source: Any, target: Any, factor: float, confidence: float | None, **options: Any
) -> Plan:
    try:
        scaled = multiplied(source, factor)
    except ValueError as error:
        raise ValueError(
            f"scale: got {factor:g}, with which the source has no usable coordinates: {error}"
        ) from error
    plan = planned(scaled, target, **options)
    return dataclasses.replace(plan, scale=factor, scale_confidence=confidence)
