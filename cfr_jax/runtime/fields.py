"""Type checks for a dataclass that is filled in from a config file and flags."""

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
    """Raises ValueError if the value of a dataclass field does not have the field's type.

    The annotations must be types, not strings. For a tuple or a dict, only the container is
    checked. An int is accepted where a float is wanted. `where` is put before the field's name in
    the message.
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
