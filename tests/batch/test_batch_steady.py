"""Long batches: nothing grows with their length but what has to, and every bit stays the same."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import batch_samples
import jax
import pytest
from peak_memory import memory, reset_peak

from cfr_jax.batch.jobs import jobs_of
from cfr_jax.batch.stream import align_many
from cfr_jax.data.layout import recognize

on_linux = pytest.mark.skipif(sys.platform != "linux", reason="measures memory as Linux tells it")


@pytest.mark.slow
@on_linux
def test_a_million_pairs_are_listed_in_seconds_and_little_memory(tmp_path):
    listed = tmp_path / "pairs.csv"
    listed.write_text("source,target\n" + "".join(f"a.ply,b{i}.ply\n" for i in range(10**6)))
    (tmp_path / "a.ply").touch()
    before, start = reset_peak(), time.process_time()

    jobs, _ = jobs_of(recognize(listed))
    first = jobs[0]

    assert len(jobs) == 10**6
    assert first.pair == (tmp_path / "a.ply", tmp_path / "b0.ply")
    assert memory("VmHWM") - before < 256 << 20  # held as objects, they took 930 MB
    assert time.process_time() - start < 30  # and 105 s


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
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "XLA_FLAGS": flags,
        }  # fmt: skip
        child = subprocess.run(
            [sys.executable, "-c", _ANSWERS, jax.config.jax_compilation_cache_dir, str(cores)],
            capture_output=True, text=True, timeout=900, env=environment,
        )  # fmt: skip
        assert child.returncode == 0, child.stderr[-2000:]
        told += child.stdout.split()

    assert len(told) == 6 and len(set(told)) == 1
