"""The kernels of a call on an accelerator and their times, from JAX's own profiler."""

from __future__ import annotations

import collections
import tempfile
from collections.abc import Callable
from pathlib import Path

import jax

_MOST = 6  # kinds of kernels that are listed


def profile(call: Callable[[], object]) -> dict:
    """The number of kernels in one call, their total milliseconds, and the slowest kinds.

    Empty on a CPU, which has no kernels.
    """
    if jax.default_backend() == "cpu":
        return {}
    jax.block_until_ready(call())
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready(call())
        (trace,) = Path(folder).rglob("*.xplane.pb")
        data = jax.profiler.ProfileData.from_file(str(trace))
    spent: collections.Counter[str] = collections.Counter()
    count = 0
    for plane in data.planes:
        if not plane.name.startswith("/device:"):
            continue
        for line in plane.lines:
            if line.name.startswith("Stream"):
                for event in line.events:
                    count += 1
                    spent[event.name.rstrip("0123456789_")] += event.duration_ns / 1e6
    top = {name: round(ms, 3) for name, ms in spent.most_common(_MOST)}
    return {"kernels": count, "kernel_ms": round(spent.total(), 3), "top_ms": top}
