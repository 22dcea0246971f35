"""From clues to a probability: logistic regressions whose coefficients belong to the weights.

A network trained on other data answers otherwise, so that what its clues are worth is measured for
each set of weights (`evaluation.calibration`, `cfr calibrate`) and kept with them: as a note of
their file, and in the parameters as `params["calibration"]`. There it is a part of the tree without
leaves. Gradients, optimizers and `jax.tree.map` pass it by, a compiled program has its numbers
inside, and networks do not look at it.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Collection, Mapping
from typing import Any, Literal

import jax

KEY = "calibration"
"""What it is called in parameters, and among the notes of a file."""
BIAS = "bias"
SURE = 30.0  # larger logits are rounding

Coefficients = tuple[tuple[str, float], ...]


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Calibration:
    """The coefficients of both confidences: of each clue by name, and the bias."""

    register: Coefficients
    """For what `register` tells, from the network's clues."""
    align: Coefficients
    """For what `align` tells, from those and the surfaces' clues."""

    @classmethod
    def read(cls, text: str) -> Calibration:
        """From a note; raises ValueError where it is damaged, which `write` never is."""
        try:
            held = json.loads(text)
        except ValueError as error:
            raise ValueError(f"calibration: the note is no JSON ({error})") from error
        if not isinstance(held, dict) or set(held) != {"register", "align"}:
            told = sorted(held) if isinstance(held, dict) else type(held).__name__
            raise ValueError(f"calibration: got {told}, wanted register and align")
        return cls(*(_checked(name, held[name]) for name in ("register", "align")))

    @classmethod
    def of(cls, register: Mapping[str, float], align: Mapping[str, float]) -> Calibration:
        """From coefficients by name; raises ValueError for what are none."""
        return cls(_checked("register", register), _checked("align", align))

    def write(self) -> str:
        """As a note; numbers keep all their digits."""
        return json.dumps({"register": dict(self.register), "align": dict(self.align)})

    def check(self, which: Literal["register", "align"], clues: Collection[str]) -> None:
        """Raises ValueError unless the coefficients of one confidence are of these clues."""
        found = {clue for clue, _ in getattr(self, which)} - {BIAS}
        if found != set(clues):
            differing = ", ".join(sorted(found ^ set(clues)))
            raise ValueError(
                f"calibration: {which} has other clues than are known here ({differing}); "
                "`cfr calibrate` fits it anew"
            )


def calibration_of(params: Mapping[str, Any]) -> Calibration | None:
    """What the parameters carry; None where nobody calibrated them."""
    return params.get(KEY)


def uncalibrated(params: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters alone: what is trained, and what others are fitted to anew."""
    return {name: branch for name, branch in params.items() if name != KEY}


def logit(fitted: Coefficients, clues: Mapping[str, Any]) -> Any:
    """The bias and the weighted sum of the clues, by name."""
    weights = dict(fitted)
    return weights[BIAS] + sum(weight * clues[name] for name, weight in fitted if name != BIAS)


def _checked(name: str, given: Any) -> Coefficients:
    def is_number(value: Any) -> bool:
        return isinstance(value, int | float) and not isinstance(value, bool)

    if not isinstance(given, Mapping) or BIAS not in given:
        raise ValueError(f"calibration: {name} has no bias; wanted a coefficient of every clue")
    for clue, value in given.items():
        if not is_number(value) or not math.isfinite(value):
            raise ValueError(f"calibration: {name}.{clue} is {value!r}, wanted a finite number")
    return tuple((str(clue), float(value)) for clue, value in given.items())
