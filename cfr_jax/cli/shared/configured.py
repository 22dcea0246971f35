"""Programs whose settings are a config file, of which any field can be set on the command line."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from absl import app

_MISTAKES = (AttributeError, IndexError, KeyError, SyntaxError, TypeError, ValueError)


def run(main: Callable[[Sequence[str]], None]) -> None:
    """`absl.app.run`, with a few lines instead of a traceback for a flag that cannot be used."""
    app.run(main, flags_parser=_parse)


def _parse(arguments: Sequence[str]) -> Sequence[str]:
    try:
        return app.parse_flags_with_usage(list(arguments))
    except _MISTAKES as error:  # whatever a config file or ml_collections makes of a field
        wrong = " ".join(str(error).split())
        raise SystemExit(
            f"{Path(sys.argv[0]).name}: error: a field of the config cannot be set so: {wrong}\n"
            "The fields stand in the config file, as --config.train.peak_rate=3e-4; those of a "
            "list by their place: '--config.phases[0].steps=20'"
        ) from error
