"""What public functions that run JAX have in common: where they refuse to run, and how they do."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax

P = ParamSpec("P")
T = TypeVar("T")

_first: list[int] = []  # the process in which one of them was first called


def entry(function: Callable[P, T]) -> Callable[P, T]:
    """A public function that runs JAX: refused in forked processes, and with `ranks_may_differ`."""
    inner = ranks_may_differ(function)

    @functools.wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> T:
        refuse_if_forked()
        return inner(*args, **kwargs)

    return run


def refuse_if_forked() -> None:
    """Raises RuntimeError in a process that was forked from one in which JAX was used here.

    Of JAX's threads, a forked process has none: it would wait for them without end.
    """
    process = os.getpid()
    if not _first:
        _first.append(process)
    elif _first[0] != process:
        raise RuntimeError(
            f"cfr_jax was used in process {_first[0]} before {process} was forked from it, and JAX "
            "does not run in forked processes: start workers by "
            'multiprocessing.get_context("spawn") or "forkserver", or fork before the first call'
        )


def ranks_may_differ(function: Callable[P, T]) -> Callable[P, T]:
    """The function, in which arrays of different rank may meet whatever the caller's setting.

    With `jax_numpy_rank_promotion` at "raise" or "warn", people look for mistakes in their own
    programs. In ours, vectors meet the rows of matrices on purpose.
    """

    @functools.wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> T:
        if jax.numpy_rank_promotion.value == "allow":
            return function(*args, **kwargs)
        with jax.numpy_rank_promotion("allow"):
            return function(*args, **kwargs)

    return run
