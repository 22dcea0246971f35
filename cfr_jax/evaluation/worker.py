"""A method in a process of its own, which may crash or hang without taking the run along.

Nothing numerical is imported at the top: the process first limits itself to its cores, and the
libraries that it imports afterwards size their thread pools by that.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cfr_jax.data.pairs import Pair
    from cfr_jax.evaluation.methods import Answer, Method

START_UP = 600.0  # seconds that importing, compiling and a first call may take


class Failed(RuntimeError):
    """The method did not answer: it raised, crashed, or took too long."""


class Missing(RuntimeError):
    """The method cannot run here at all: a library is missing."""


@dataclass(frozen=True)
class Started:
    """What a process tells of itself once it is warm."""

    seconds: float
    """Imports, compilation, and what else only the first call costs."""
    threads: int
    device: str


class Worker:
    """Runs one method; a context manager. After a failure the next call starts a new process."""

    def __init__(self, method: Method):
        self._method = method
        self._process: Any = None
        self._pipe: Any = None
        self.started: Started | None = None

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def solve(self, pairs: Sequence[Pair], timeout: float) -> list[Answer]:
        """The answers, or `Failed` (also after `timeout` seconds a pair), or `Missing`."""
        allowed = timeout * len(pairs)
        if self._process is None:
            self._start()
            allowed += START_UP
        try:
            self._pipe.send(list(pairs))
            if not self._pipe.poll(allowed):
                self.stop()
                raise Failed(f"no answer within {timeout:g} s a pair")
            kind, content, started = self._pipe.recv()
        except (EOFError, OSError):
            self._process.join(5)
            code = self._process.exitcode
            self.stop()
            raise Failed(f"its process ended ({_reason(code)})") from None
        self.started = self.started or started
        if kind == "missing":
            raise Missing(content)
        if kind == "failed":
            raise Failed(content)
        return content

    def stop(self) -> None:
        """Ends the process, whatever it is doing."""
        if self._process is None:
            return
        self._pipe.close()
        self._process.kill()
        self._process.join()
        self._process = self._pipe = None

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")  # forked copies of JAX or OpenMP hang
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(theirs, self._method.make, self._method.threads), daemon=True
        )
        self._process.start()
        theirs.close()


def _serve(pipe: Any, make: Any, threads: int) -> None:
    """The child: solves what comes through the pipe until it closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends us
    threads = limit_threads(threads)
    solve, started = None, None
    while True:
        try:
            pairs = pipe.recv()
        except EOFError:
            return
        try:
            if solve is None:
                began = time.perf_counter()
                solver = make()
                solver(pairs)
                solve, warm = solver, time.perf_counter()
                answers = solve(pairs)
                extra = (warm - began) - (time.perf_counter() - warm)
                started = Started(max(0.0, extra), threads, _device())
            else:
                answers = solve(pairs)
            reply = ("done", answers, started)
        except ModuleNotFoundError as error:
            reply = ("missing", str(error), None)
        except Exception as error:  # whatever a method may raise, it is that method's failure
            reply = ("failed", f"{type(error).__name__}: {error}", None)
        pipe.send(reply)


def limit_threads(threads: int) -> int:
    """Keeps this process on its first `threads` cores (0: all it has); returns how many it has."""
    if not hasattr(os, "sched_setaffinity"):
        return os.cpu_count() or 1
    cores = sorted(os.sched_getaffinity(0))
    if 0 < threads < len(cores):
        os.sched_setaffinity(0, cores[:threads])
    return len(os.sched_getaffinity(0))


def _device() -> str:
    jax = sys.modules.get("jax")
    if jax is None or jax.default_backend() == "cpu":
        return "CPU"
    return jax.devices()[0].device_kind


def _reason(code: int | None) -> str:
    if code is None:
        return "closed its pipe"
    if code < 0:
        return signal.Signals(-code).name
    return f"exit code {code}"
