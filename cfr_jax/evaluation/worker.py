"""Runs a method in its own process, so that a crash or a hang does not end the whole run.

Nothing numerical is imported at the top: the process first limits itself to its cores, and the
libraries that it imports afterwards size their thread pools accordingly.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cfr_jax.data.pairs import Pair
    from cfr_jax.evaluation.methods import Method
    from cfr_jax.evaluation.solvers.solver import Answer

START_UP = 600.0  # seconds that imports may take, and then again compilation


class Failed(RuntimeError):
    """The method gave no answer: it raised an error, crashed, or took too long."""


class Missing(RuntimeError):
    """The method cannot run here at all: a library is missing."""


@dataclass(frozen=True)
class Started:
    """What a process reports about itself after its first call."""

    seconds: float
    """Time for imports, compilation, and whatever else only the first call needs."""
    threads: int
    device: str


class Worker:
    """Runs one method; a context manager. After a failure the next call starts a new process."""

    def __init__(self, method: Method):
        self._method = method
        self._process: Any = None
        self._pipe: Any = None
        self._warm = False
        self._unmade: str | None = None
        self.started: Started | None = None

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def solve(self, pairs: Sequence[Pair], timeout: float) -> list[Answer]:
        """The answers to all pairs.

        Raises `Failed` if the method fails or takes more than `timeout` seconds per pair, and
        `Missing` if it cannot run at all.
        """
        if self._unmade is not None:
            raise Failed(self._unmade)
        allowed = timeout * len(pairs)
        if self._process is None:
            self._start()
        if not self._warm:
            # the first call solves twice, and at first its start-up time is unknown
            allowed += allowed + (START_UP if self.started is None else 3 * self.started.seconds)
        late = f"no answer within {timeout:g} s per pair"
        answers, self.started = self._reply(list(pairs), allowed, late)
        self._warm = True
        return answers

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")  # forked copies of JAX or OpenMP hang
        pipe, theirs = context.Pipe()
        process = context.Process(
            target=_serve, args=(theirs, self._method.make, self._method.threads), daemon=True
        )
        try:
            process.start()
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            pipe.close()
            raise ValueError(
                f"methods.{self._method.name}: cannot be sent to its own process ({error}); wanted "
                "functions that can be imported there by name, not lambdas or inner functions"
            ) from error
        finally:
            theirs.close()
        self._pipe, self._process = pipe, process
        try:
            self._reply(None, START_UP, f"it did not start within {START_UP:g} s")
        except (Failed, Missing):
            self.stop()
            raise

    def _reply(self, request: Any, seconds: float, late: str) -> Any:
        """The answer of the process to a request; None only asks whether it has started."""
        try:
            if request is not None:
                self._pipe.send(request)
            if not self._pipe.poll(seconds):
                self.stop()
                raise Failed(late)
            kind, content = self._pipe.recv()
        except (EOFError, OSError):
            self._process.join(5)
            code = self._process.exitcode
            self.stop()
            raise Failed(f"its process ended ({_reason(code)})") from None
        if kind == "missing":
            raise Missing(content)
        if kind == "failed":
            if request is None:
                self._unmade = content  # it would fail again for every pair
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
        self._warm = False


def _serve(pipe: Any, make: Any, threads: int) -> None:
    """The child process: makes the method, then solves pairs from the pipe until it closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends us
    threads = limit_threads(threads)
    began = time.perf_counter()
    kind, solve = _attempt(make)
    made = time.perf_counter() - began
    pipe.send((kind, None if kind == "done" else solve))
    started = None
    while kind == "done":
        try:
            pairs = pipe.recv()
        except EOFError:
            return
        if started is None:
            reply = _attempt(_first_call, solve, pairs, made, threads)
            started = reply[1][1] if reply[0] == "done" else None
        else:
            outcome, answers = _attempt(solve, pairs)
            reply = outcome, (answers, started) if outcome == "done" else answers
        pipe.send(reply)


def _attempt(action: Any, *arguments: Any) -> tuple[str, Any]:
    try:
        return "done", action(*arguments)
    except ModuleNotFoundError as error:
        return "missing", str(error)
    except Exception as error:  # whatever a method raises, only that method fails
        return "failed", f"{type(error).__name__}: {error}"


def _first_call(solve: Any, pairs: Any, made: float, threads: int) -> tuple[Any, Started]:
    """Solves twice: the extra time of the first call counts as start-up time."""
    times = [time.perf_counter()]
    for _ in range(2):
        answers = solve(pairs)
        times.append(time.perf_counter())
    extra = (times[1] - times[0]) - (times[2] - times[1])
    return answers, Started(made + max(0.0, extra), threads, _device())


def limit_threads(threads: int) -> int:
    """Limits this process to its first `threads` cores (0: all); returns how many it then has."""
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
