"""Reasons for a training to end early: it was asked to stop, and saves first, or it diverged."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import jax


class Stopped(Exception):
    """A training was asked to stop by `signal`, and has saved everything."""

    def __init__(self, message: str, number: int):
        super().__init__(message)
        self.signal = number


class Diverged(ValueError):
    """The gradients, or the answers of the weights, are no longer finite."""


class Requests:
    """`received` is the first signal that arrived, or None."""

    received: int | None = None


@contextmanager
def stop_requests() -> Iterator[Requests]:
    """Inside this context, the first SIGINT (Ctrl-C) or SIGTERM is only noted.

    The second one acts as usual. If there are several processes, none may stop alone while the
    others wait for it; so then, and outside the main thread, even the first signal acts as usual.
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
