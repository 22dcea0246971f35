"""Files that grow when they are read stay within the budget, or are refused: 64 MB and four times
the file, and a second of one core for 10 MB.

Each file is read in a process of its own, forked from one that has loaded everything before, so
that no memory is left over from another file. What that process allocated at its peak is the cost.
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
from collections.abc import Callable
from pathlib import Path

import pytest
from amplifiers import makers
from peak_memory import memory, reset_peak

SECONDS, BYTES, BYTES_PER_BYTE = 1.0, 64 << 20, 4
_ADDRESS_SPACE, _LONGEST = 12 << 30, 60  # end what runs away before it takes the machine


def in_a_fork(call: Callable[..., dict], *given: object) -> dict:
    """What `call` returns in a fork of this process, whose memory then goes with it."""
    told, tell = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(told)
        with os.fdopen(tell, "w") as stream:
            json.dump(call(*given), stream)
            stream.flush()
            os._exit(0)
    os.close(tell)
    with os.fdopen(told) as stream:
        text = stream.read()
    _, status = os.waitpid(child, 0)
    return json.loads(text) if text else {"died": status}


def _make(path: Path, name: str, size: int, seed: str) -> dict:
    path.write_bytes(makers()[name](size, random.Random(seed)))
    return {"size": path.stat().st_size}


def read_and_measure(path: Path, whole: bool) -> dict:
    from cfr_jax.io import CloudFileError, read

    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
    resource.setrlimit(resource.RLIMIT_CPU, (_LONGEST, _LONGEST))
    before, start = reset_peak(), time.process_time()
    error = ""
    try:
        read(path, properties=whole)
    except CloudFileError as refusal:
        error = str(refusal)
    except BaseException as other:
        return {"raised": f"{type(other).__name__}: {other}"}
    seconds = time.process_time() - start
    return {"seconds": seconds, "bytes": memory("VmHWM") - before, "error": error}


def know_formats_of_corpora() -> None:
    """Lets this process read what only corpora are made of as any other file."""
    from cfr_jax.data.making.mesh_formats import mesh_formats
    from cfr_jax.io import formats

    for form in mesh_formats():
        if form not in formats.entries():
            formats.add(form)


def run_cases(size: int, seeds: int, names: list[str]) -> dict[str, dict]:
    """The cost of each kind of file with each seed, bare and with all properties."""
    know_formats_of_corpora()
    warnings.simplefilter("ignore")
    costs = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in names or makers():
            warm = Path(folder) / f"small {name}"
            in_a_fork(_make, warm, name, 3_000, name)
            for whole in (False, True):  # what is loaded only once is no cost of a file
                read_quietly(warm, whole)
            for seed in range(seeds):
                path = Path(folder) / name
                made = in_a_fork(_make, path, name, size, f"{name} {seed}")
                for whole in (False, True):
                    costs[f"{name}, {seed}, {whole}"] = made | in_a_fork(
                        read_and_measure, path, whole
                    )
                path.unlink()
    return costs


def read_quietly(path: Path, whole: bool) -> None:
    from cfr_jax.io import CloudFileError, read

    if path.stat().st_size > 100_000:
        return
    try:
        read(path, properties=whole)
    except CloudFileError:
        pass


def excesses(costs: dict[str, dict]) -> list[str]:
    """In words, what took more than it may."""
    found = []
    for case, cost in costs.items():
        if "bytes" not in cost:
            found.append(f"{case}: {cost}")
        elif cost["bytes"] > BYTES + BYTES_PER_BYTE * cost["size"]:
            found.append(f"{case}: {cost['bytes'] >> 20} MiB for {cost['size'] / 1e6:.2f} MB")
        elif cost["seconds"] > SECONDS * max(cost["size"] / 1e7, 1):
            found.append(f"{case}: {cost['seconds']:.2f} s for {cost['size'] / 1e6:.2f} MB")
    return found


def measured(size: int, seeds: int, names: tuple[str, ...] = (), seconds: int = 500) -> dict:
    """`run_cases` in a fresh interpreter."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    child = subprocess.run(
        [sys.executable, __file__, str(size), str(seeds), *names],
        capture_output=True, text=True, timeout=seconds, env=environment,
    )  # fmt: skip
    assert child.returncode == 0, child.stderr[-2000:]
    return json.loads(child.stdout)


def test_files_that_grow_stay_within_four_times_their_size_and_a_second_for_ten_megabytes():
    costs = measured(2_000_000, 1)
    assert len(costs) == 2 * len(makers())
    assert excesses(costs) == []


@pytest.mark.slow
@pytest.mark.parametrize("size", [300_000, 12_000_000, 50_000_000])
@pytest.mark.parametrize("name", makers())
def test_files_that_grow_stay_within_their_budget_at_every_size(name, size):
    costs = measured(size, 3 if size < 50_000_000 else 2, (name,))
    assert len(costs) > 0
    assert excesses(costs) == []


def test_the_meter_sees_memory_and_time():
    """Of a file of 24 MB, 24 MB are read and 36 MB are made; the heap has a few to spare."""
    costs = measured(24_000_000, 1, ("scan.bin",))
    for cost in costs.values():
        assert cost["error"] == ""
        assert 0.8 * 60e6 < cost["bytes"] < 4 * 24e6 + BYTES
        assert 0.005 < cost["seconds"]


if __name__ == "__main__":
    print(json.dumps(run_cases(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3:])))
