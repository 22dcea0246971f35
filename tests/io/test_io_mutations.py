"""Damaged files of every format: they are read, or refused by `CloudFileError`, fast and small.

The reading is done by a process of its own, whose peak of memory is then the readers' and whose
death, should compiled code bring it about, is a failure of the test and not its end.
"""

from __future__ import annotations

import json
import os
import random
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
from io_samples import write_clouds, write_meshes
from kind_samples import all_kinds, solids
from mutants import mutate
from peak_memory import memory, reset_peak

CASES = 4000
SECONDS = 1.0
BYTES = 64 << 20
BYTES_PER_BYTE = 4
_ADDRESS_SPACE = 8 << 30  # ends a runaway allocation before it takes the machine


def run_cases(cases: int, seed: int) -> dict:
    """Reads that many damaged files, and tells what was wrong about how that went."""
    from cfr_jax.io import CloudFileError, CloudWarning, read

    warnings.simplefilter("error")
    warnings.simplefilter("ignore", CloudWarning)  # a damaged name of a column may bring it about
    failures: list[str] = []
    refused = 0
    slowest, largest = 0.0, 0
    messages: set[str] = set()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        files = {**write_clouds(place), **write_meshes(place)}
        originals = {name: path.read_bytes() for name, path in sorted(files.items())}
        originals |= {f"{kind} {name}": data for kind, (name, data) in all_kinds().items()}
        originals["solids.stl"] = solids()
        for path in files.values():  # what is loaded only once is no cost of a case
            read(path)
        names = sorted(originals)
        resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
        for case in range(cases):
            name = names[case % len(names)]
            data = mutate(originals[name], random.Random(f"{seed} {case}"))
            path = place / f"case{Path(name).suffix}"
            path.write_bytes(data)
            before = reset_peak()
            start = time.perf_counter()
            try:
                cloud = read(path, properties=case % 2 == 1)
                assert len(cloud) > 0 and np.isfinite(cloud.points).all()
            except CloudFileError as error:
                refused += 1
                messages.add(str(error))
                if str(path) not in str(error):
                    failures.append(f"case {case} of {name}: unnamed: {error}")
            except BaseException as error:
                failures.append(f"case {case} of {name}: {type(error).__name__}: {error}")
            seconds = time.perf_counter() - start
            grown = memory("VmHWM") - before
            if seconds > SECONDS:
                failures.append(f"case {case} of {name}: took {seconds:.1f} s")
            if grown > BYTES + BYTES_PER_BYTE * len(data):
                failures.append(f"case {case} of {name}: took {grown >> 20} MiB")
            slowest, largest = max(slowest, seconds), max(largest, grown)
    before = reset_peak()
    bytearray(101 << 20)
    meter = memory("VmHWM") - before
    return {
        "meter": meter,
        "failures": failures, "refused": refused, "messages": len(messages), "slowest": slowest,
        "largest": largest, "cases": cases,
    }  # fmt: skip


def test_damaged_files_are_read_or_refused_within_a_second_and_littlememory():
    # given
    command = [sys.executable, __file__, str(CASES), "0"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}

    # when
    child = subprocess.run(command, capture_output=True, text=True, timeout=300, env=environment)

    # then
    assert child.returncode == 0, child.stderr[-2000:]
    outcome = json.loads(child.stdout)
    assert outcome["failures"] == []
    assert outcome["cases"] == CASES
    assert outcome["meter"] >= 100 << 20  # the peak of memory is seen where there is one
    assert CASES // 4 < outcome["refused"] < CASES  # the damage was neither nothing nor all


if __name__ == "__main__":
    print(json.dumps(run_cases(int(sys.argv[1]), int(sys.argv[2]))))
