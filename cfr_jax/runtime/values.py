"""Records that hold arrays, compared by value.

The `==` that Python gives to a dataclass asks two tuples of arrays whether they are equal, and
arrays answer with arrays.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, ClassVar

import numpy as np


class ByValue:
    """Mixed into a dataclass (with `eq=False`): two are equal if their classes are the same and all
    of their fields are equal, bit by bit; NaN equals NaN.

    Equal ones have equal hashes: these depend on the shapes of the arrays alone, as arrays can be
    written into.
    """

    __slots__ = ()
    _not_compared: ClassVar[tuple[str, ...]] = ()

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return all(_equal(mine, getattr(other, name)) for name, mine in self._compared())

    def __hash__(self) -> int:
        parts = ((name, getattr(value, "shape", ())) for name, value in self._compared())
        return hash((type(self).__qualname__, *parts))

    def _compared(self) -> list[tuple[str, Any]]:
        mine: Any = self
        names = (each.name for each in fields(mine) if each.name not in self._not_compared)
        return [(name, getattr(mine, name)) for name in names]


def _equal(first: Any, second: Any) -> bool:
    if first is second:
        return True
    if isinstance(first, tuple | list) and isinstance(second, tuple | list):
        pairs = zip(first, second, strict=False)
        return len(first) == len(second) and all(_equal(*pair) for pair in pairs)
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        return first.keys() == second.keys() and all(_equal(first[k], second[k]) for k in first)
    if hasattr(first, "__array__") and hasattr(second, "__array__"):
        first, second = np.asarray(first), np.asarray(second)
        if first.shape != second.shape:
            return False
        return bool(np.all((first == second) | ((first != first) & (second != second))))
    return bool(first == second) or bool(first != first and second != second)
