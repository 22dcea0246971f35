"""Long batches: nothing grows with their length but what has to, and every bit stays the same."""

from __future__ import annotations

import os
import subprocess
import sys

import batch_samples
import jax
import pytest
from peak_memory import memory

from cfr_jax.batch.stream import align_many

on_linux = pytest.mark.skipif(sys.platform != "linux", reason="measures memory as Linux tells it")


# in a process of its own: checks of types at every call would take most of the time
_LISTED = """
import sys, time
from pathlib import Path
from peak_memory import memory, reset_peak
from cfr_jax.batch.jobs import jobs_of
from cfr_jax.data.layout import recognize
before, start = reset_peak(), time.process_time()
jobs, _ = jobs_of(recognize(Path(sys.argv[1])))
first = jobs[0]
print(len(jobs), first.target, time.process_time() - start, memory("VmHWM") - before)
"""


@pytest.mark.slow
@on_linux
def test_a_million_pairs_are_listed_in_seconds_and_little_memory(tmp_path):
    listed = tmp_path / "pairs.csv"
    listed.write_text("source,target\n" + "".join(f"a.ply,b{i}.ply\n" for i in range(10**6)))
    (tmp_path / "a.ply").touch()

    count, target, seconds, held = in_a_child(_LISTED, str(listed)).split()

    assert (count, target) == ("1000000", "b0.ply")
    assert int(held) < 256 << 20  # as one object for each, they took 930 MB
    assert float(seconds) < 20  # and 105 s


@pytest.mark.slow
@on_linux
def test_memory_is_flat_over_two_thousand_pairs():
    pairs = [batch_samples.pair(i) for i in range(5)]
    held = []

    for outcome in align_many((pairs[i % 5] for i in range(2000)), refine=False, second_look=False):
        assert outcome.error is None
        if outcome.index % 100 == 99:
            held.append(memory("VmRSS"))

    assert len(held) == 20
    assert max(held[2:]) - held[1] < 16 << 20  # a pair and its answer take 20 kB: 36 MB if kept


_ANSWERS = """
import hashlib, os, sys
from concurrent.futures import ThreadPoolExecutor
import jax
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: int(sys.argv[2])])
import batch_samples
from cfr_jax.alignment.align import align

def answer(i):
    found = align(*batch_samples.pair(i))
    return found.transform.tobytes() + found.weights.tobytes() + repr(found.confidence).encode()

with ThreadPoolExecutor(3) as pool:
    for answers in (map(answer, range(3)), pool.map(answer, range(3))):
        print(hashlib.sha256(b"".join(answers)).hexdigest())
"""


@pytest.mark.slow
@on_linux
def test_the_bits_are_the_same_over_threads_processes_and_repeats():
    told = []
    for cores, flags in ((1, ""), (64, ""), (64, "--xla_cpu_multi_thread_eigen=false")):
        cache = jax.config.jax_compilation_cache_dir
        told += in_a_child(_ANSWERS, cache, str(cores), XLA_FLAGS=flags).split()

    assert len(told) == 6 and len(set(told)) == 1


def in_a_child(code: str, *arguments: str, **variables: str) -> str:
    """What a fresh interpreter prints."""
    paths = os.pathsep.join(filter(None, sys.path))
    child = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True, text=True, timeout=900,
        env=os.environ | {"PYTHONPATH": paths} | variables,
    )  # fmt: skip
    assert child.returncode == 0, child.stderr[-2000:]
    return child.stdout
