"""Checks the types of a dataclass that a config file and flags fill in."""

from __future__ import annotations

import types
import typing
from dataclasses import fields
from typing import Any

_WORDS = {
    int: "a whole number",
    float: "a number",
    str: "a text",
    bool: "True or False",
    tuple: "a tuple",
    dict: "a dict",
    types.NoneType: "None",
}


def check_types(record: Any, where: str = "") -> None:
    """Raises ValueError for a field of a dataclass whose value is not of its type.

    The annotations must be types, not texts. Of a tuple or a dict only the container is checked; a
    whole number is a number. `where` stands before the name of the field in the message.
    """
    for each in fields(record):
        value = getattr(record, each.name)
        wanted = [typing.get_origin(kind) or kind for kind in _alternatives(each.type)]
        if not any(_fits(value, kind) for kind in wanted):
            words = " or ".join(_WORDS.get(kind, kind.__name__) for kind in wanted)
            raise ValueError(f"{where}{each.name}: got {value!r}, wanted {words}")


def _alternatives(annotation: Any) -> tuple[Any, ...]:
    if isinstance(annotation, types.UnionType):
        return typing.get_args(annotation)
    return (annotation,)


def _fits(value: object, kind: Any) -> bool:
    if kind not in _WORDS:
        return isinstance(value, kind)
    if isinstance(value, bool):
        return kind is bool
    return isinstance(value, (int, float) if kind is float else kind)
