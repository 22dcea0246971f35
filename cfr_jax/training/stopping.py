"""Why a training ends early: asked to, it ends its step and saves; diverged, it says so."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import jax


class Stopped(Exception):
    """A training that was asked to stop has saved all it did; `signal` asked for it."""

    def __init__(self, message: str, number: int):
        super().__init__(message)
        self.signal = number


class Diverged(ValueError):
    """The gradients, or what the weights answer, are no numbers any more."""


class Requests:
    """`received` is the first signal that came, or None."""

    received: int | None = None


@contextmanager
def stop_requests() -> Iterator[Requests]:
    """Within, the first SIGINT (Ctrl-C) or SIGTERM is only noted; the second acts as ever.

    Of several processes none may stop alone while the others wait for it, so there, and outside a
    program's main thread, signals act as ever from the first one on.
    """
    requests = Requests()
    usual: dict[int, Any] = {}

    def note(number: int, _: Any) -> None:
        requests.received = number
        restore()

    def restore() -> None:
        while usual:
            signal.signal(*usual.popitem())

    if jax.process_count() == 1 and threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            usual[number] = signal.signal(number, note)
    try:
        yield requests
    finally:
        restore()
