"""Medians of runs, interleaved with a large matrix product that gives the machine's current
roof."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

_SIDE = 2048  # of the square matrices in the product, which takes 17 GFLOP


@dataclass
class Line:
    """One measurement."""

    group: str
    name: str
    points: int
    batch: int
    runs: int
    milliseconds: float
    """Median over the runs, for the whole batch."""
    fastest: float
    compile_seconds: float
    gflop: float | None
    roof: float
    """GFLOP/s of a large float32 product, median of the products run in between."""
    share: float | None
    """Share of the roof that the arithmetic reaches."""
    settings: dict = field(default_factory=dict)

    def as_dict(self) -> dict:
        """The line as a dict for the result file."""
        return asdict(self)


def program(function: Callable, *arguments) -> tuple[Callable, float]:
    """`function` compiled for arguments of these shapes, and the seconds that compiling took."""
    began = time.perf_counter()
    # in a lambda, because jit hashes its function and a bound network cannot be hashed
    made = jax.jit(lambda *given: function(*given)).lower(*arguments).compile()
    return made, time.perf_counter() - began


def compiled(function: Callable, *arguments) -> tuple[Callable[[], object], float]:
    """The same, as a call on these arguments."""
    made, seconds = program(function, *arguments)
    return (lambda: made(*arguments)), seconds


class Clock:
    """The time that is left, and the cases that no longer fit into it."""

    def __init__(self, seconds: float):
        self.end = time.monotonic() + seconds
        self.left_out: list[str] = []

    def left(self) -> float:
        """The seconds that are left."""
        return max(0.0, self.end - time.monotonic())

    def has(self, seconds: float, what: str) -> bool:
        """Whether this many seconds are left. If not, `what` is recorded as left out."""
        if self.left() >= seconds:
            return True
        self.left_out.append(what)
        return False


class Roof:
    """A float32 matrix product that is large enough to show what the cores can do."""

    def __init__(self):
        self._matrix = jnp.asarray(np.random.default_rng(0).random((_SIDE, _SIDE), np.float32))
        self._call, _ = compiled(lambda a: jnp.matmul(a, a, precision="highest"), self._matrix)
        jax.block_until_ready(self._call())

    def measure(self) -> float:
        """GFLOP/s of one run."""
        return 2 * _SIDE**3 / timed(self._call) / 1e9


def timed(call: Callable[[], object]) -> float:
    """Seconds of one call, including the wait for its results."""
    began = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - began


def measure(
    roof: Roof,
    call: Callable[[], object],
    *,
    group: str,
    name: str,
    points: int,
    batch: int = 1,
    flop: float | None = None,
    compile_seconds: float = 0.0,
    runs: int = 9,
    limit: float = 60.0,
    settings: dict | None = None,
) -> Line:
    """Measures at most `runs` runs, fewer if they take longer than `limit` seconds.

    If a run is short, an uncounted run precedes each counted one, because the product in between
    (50 MB) has emptied the caches. A call that takes longer than a quarter of the limit is not
    warmed up.
    """
    began = time.perf_counter()
    times, roofs = [timed(call)], [roof.measure()]
    short = times[0] < limit / (4 * runs)
    if times[0] < limit / 4:
        times.clear()
    while len(times) < runs and (not times or time.perf_counter() - began < limit):
        roofs.append(roof.measure())
        if short:
            timed(call)
        times.append(timed(call))
    median, ceiling = float(np.median(times)), float(np.median(roofs))
    return Line(
        group,
        name,
        points,
        batch,
        len(times),
        1e3 * median,
        1e3 * min(times),
        compile_seconds,
        None if flop is None else flop / 1e9,
        ceiling,
        None if flop is None else flop / 1e9 / median / ceiling,
        settings or {},
    )
