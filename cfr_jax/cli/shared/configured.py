"""Programs that read a config file and let flags set any of its fields."""

from __future__ import annotations

import dataclasses
import difflib
import pydoc
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from absl import app

_MISTAKES = (AttributeError, IndexError, KeyError, SyntaxError, TypeError, ValueError)
# how ml_collections reports a field that a dataclass does not have
_UNKNOWN = (
    re.compile(r"Field (?P<name>\S+) not found on dataclass <class '(?P<section>\S+)'>"),
    re.compile(r"Attribute <class '(?P<section>\S+)'>\.(?P<name>\S+) does not exist"),
)


def run(main: Callable[[Sequence[str]], None]) -> None:
    """`absl.app.run`, but a flag that cannot be used gives a few lines instead of a traceback."""
    app.run(main, flags_parser=_parse)


def _parse(arguments: Sequence[str]) -> Sequence[str]:
    try:
        return app.parse_flags_with_usage(list(arguments))
    except _MISTAKES as error:  # whatever a config file or ml_collections raises
        raise SystemExit(
            f"{Path(sys.argv[0]).name}: error: a field of the config cannot be set like this: "
            f"{_in_words(error)}\n"
            "Write a field as --config.train.peak_rate=3e-4, and an item of a list by its "
            "position: '--config.phases[0].steps=20'"
        ) from error


def _in_words(error: Exception) -> str:
    text = " ".join(str(error).split())
    for pattern in _UNKNOWN:
        if found := pattern.search(text):
            section: Any = pydoc.locate(found["section"])
            known = [each.name for each in dataclasses.fields(section)]
            close = difflib.get_close_matches(found["name"], known, 1)
            hint = f'Did you mean "{close[0]}"?' if close else f"It has {', '.join(known)}."
            return f'{section.__name__} has no field "{found["name"]}". {hint}'
    return f"there is no {text}" if isinstance(error, KeyError) else text
