"""Workers that call one function ahead of the use of its results: threads, or processes if many.

Drawing a pair of 717 points holds Python's interpreter for a quarter of its time (sampled with
py-spy), so more than about four threads would only wait for each other.
"""

from __future__ import annotations

import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import connection, get_context, parent_process
from typing import Any

_MOST_THREADS = 4

_work: Callable[[int], Any]  # in a worker process: the function that it calls


@contextmanager
def open_pool(workers: int, work: Callable[[int], Any]) -> Iterator[Callable[[int], Future[Any]]]:
    """Yields a function that has `work` called with a number by the next free worker.

    Up to four workers are threads. More are processes; each gets a copy of `work` when it starts,
    so `work` must be picklable. Calls that have not begun when the block ends are dropped.

    Raises ValueError for work that cannot be copied to another process, and RuntimeError if a
    worker process was killed.
    """
    if workers <= _MOST_THREADS:
        threads = ThreadPoolExecutor(workers)
        try:
            yield lambda number: threads.submit(work, number)
        finally:
            threads.shutdown(cancel_futures=True)
        return
    # not forked: a fork would copy the locks that threads of JAX hold at that moment
    processes = ProcessPoolExecutor(
        workers, get_context("spawn"), initializer=_begin, initargs=(work,)
    )

    def submit(number: int) -> Future[Any]:
        try:
            return processes.submit(_call, number)
        except (AttributeError, TypeError, pickle.PicklingError) as error:
            raise ValueError(
                f"workers: got {workers}, wanted at most {_MOST_THREADS} here: this source "
                f"of pairs cannot be copied to another process ({error})"
            ) from None

    try:
        yield submit
    except BrokenProcessPool:
        raise RuntimeError(
            f"one of {workers} processes that draw pairs was killed, perhaps because memory ran "
            "out; fewer workers need less"
        ) from None
    finally:
        processes.shutdown(cancel_futures=True)


def _begin(work: Callable[[int], Any]) -> None:
    """Prepares a worker process."""
    global _work
    _work = work
    os.environ["JAX_PLATFORMS"] = "cpu"  # the accelerator belongs to the training
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that trains
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A pool does not stop its workers if it is killed: they would wait for ever."""
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


def _call(number: int) -> Any:
    return _work(number)
