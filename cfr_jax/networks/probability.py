"""From clues to a probability: logistic regressions whose coefficients belong to the weights.

Networks trained on different data give different answers, so the meaning of their clues is measured
for each set of weights (`evaluation.calibration`, `cfr calibrate`). The coefficients are kept with
the weights: as a note in their file, and in the parameters as `params["calibration"]`. There they
are a part of the tree without leaves: gradients, optimizers and `jax.tree.map` skip it, a compiled
program has its numbers built in, and the networks ignore it.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Collection, Mapping
from typing import Any, Literal

import jax

KEY = "calibration"
"""The name of a calibration in parameters and among the notes of a file."""
BIAS = "bias"
SURE = 30.0  # logits are clipped to this: beyond it, probabilities round to 0 or 1

Coefficients = tuple[tuple[str, float], ...]


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Calibration:
    """The coefficients of both confidences: one for each clue, by name, and the bias."""

    register: Coefficients
    """For the confidence of `register`, from the network's clues."""
    align: Coefficients
    """For the confidence of `align`, from the network's and the surfaces' clues."""

    @classmethod
    def read(cls, text: str) -> Calibration:
        """Reads what `write` returned; raises ValueError if the note is damaged."""
        try:
            held = json.loads(text)
        except ValueError as error:
            raise ValueError(f"calibration: the note is not valid JSON ({error})") from error
        if not isinstance(held, dict) or set(held) != {"register", "align"}:
            told = sorted(held) if isinstance(held, dict) else type(held).__name__
            raise ValueError(f"calibration: got {told}, wanted register and align")
        return cls(*(_checked(name, held[name]) for name in ("register", "align")))

    @classmethod
    def of(cls, register: Mapping[str, float], align: Mapping[str, float]) -> Calibration:
        """From coefficients by name; raises ValueError for a value that is not a finite number, and
        if a bias is missing."""
        return cls(_checked("register", register), _checked("align", align))

    def write(self) -> str:
        """As a note (JSON); numbers keep all their digits."""
        return json.dumps({"register": dict(self.register), "align": dict(self.align)})

    def check(self, which: Literal["register", "align"], clues: Collection[str]) -> None:
        """Raises ValueError unless one confidence's coefficients are for exactly these clues."""
        found = {clue for clue, _ in getattr(self, which)} - {BIAS}
        if found != set(clues):
            differing = ", ".join(sorted(found ^ set(clues)))
            raise ValueError(
                f"calibration: {which} has other clues than this version knows ({differing}); "
                "run `cfr calibrate` to fit it again"
            )


def calibration_of(params: Mapping[str, Any]) -> Calibration | None:
    """The calibration in the parameters; None if they were never calibrated."""
    return params.get(KEY)


def uncalibrated(params: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters without their calibration, to train them or to fit a new calibration."""
    return {name: branch for name, branch in params.items() if name != KEY}


def logit(fitted: Coefficients, clues: Mapping[str, Any]) -> Any:
    """The bias plus the weighted sum of the clues, which are matched by name."""
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
