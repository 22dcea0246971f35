"""The factors between usual units of length."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

# How many of each unit make a meter.
_PER_METER = {"millimeters": 1000.0, "centimeters": 100.0, "inches": 1 / 0.0254,
              "feet": 1 / 0.3048, "meters": 1.0}  # fmt: skip


class Ratio(NamedTuple):
    """What lengths in `source` are multiplied by to become lengths in `target`."""

    factor: float
    source: str
    target: str


def usual() -> Iterator[Ratio]:
    """The factors between all pairs of usual units, those between equal units among them."""
    for ours, per_meter in _PER_METER.items():
        for theirs, other in _PER_METER.items():
            yield Ratio(other / per_meter, ours, theirs)


def nearest(factor: float) -> Ratio:
    """The usual ratio that is nearest to a factor."""
    return min(usual(), key=lambda ratio: abs(math.log(factor / ratio.factor)))


def in_words(factor: float) -> str:
    """The two units that a factor converts between, in words. Empty for one that is no usual ratio,
    and for 1."""
    ratio = nearest(factor)
    if ratio.factor == 1 or not math.isclose(factor, ratio.factor, rel_tol=1e-9):
        return ""
    return f"{ratio.source} to {ratio.target}"
