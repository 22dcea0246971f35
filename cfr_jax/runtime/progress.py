"""Progress: a bar on a terminal, plain lines if standard error is piped or logged."""

from __future__ import annotations

import sys
from collections.abc import Sized
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

_SECONDS = 10.0  # between plain lines
_PLAIN = "{desc}: {n_fmt} of {total_fmt}{unit}, {elapsed} so far, about {remaining} left{postfix}"


# Generic to type checkers alone.
if TYPE_CHECKING:
    _Bar = tqdm[Any]
else:
    _Bar = tqdm


class Progress(_Bar):
    """A `tqdm` that, if its stream is not a terminal, writes a plain line every ten seconds."""

    def __init__(self, *args: Any, **options: Any):
        stream = options.setdefault("file", sys.stderr)
        if not _is_terminal(stream):
            options |= {"file": _Lines(stream), "mininterval": _SECONDS, "maxinterval": _SECONDS}
            # Lines do not stack: for a bar below another one, tqdm would move the cursor.
            options["position"] = 0
            # If the total is unknown, tqdm's own format is already right.
            if _total(args, options) is not None:
                options["bar_format"] = _PLAIN
                options.setdefault("unit", "")
        super().__init__(*args, **options)


class _Lines:
    """Passes whole lines on to a stream, without the control characters that redraw a bar."""

    def __init__(self, stream: Any):
        self._stream = stream

    def write(self, text: str) -> None:
        if text.strip():
            self._stream.write(text.strip() + "\n")
            self._stream.flush()

    def flush(self) -> None:
        self._stream.flush()


def _is_terminal(stream: Any) -> bool:
    return bool(getattr(stream, "isatty", lambda: False)())


def _total(args: tuple, options: dict[str, Any]) -> int | None:
    if options.get("total") is not None:
        return options["total"]
    iterable = args[0] if args else options.get("iterable")
    return len(iterable) if isinstance(iterable, Sized) else None
