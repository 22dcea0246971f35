"""Pools of threads and of processes: the same results, errors in words, nothing left running."""

import os
import signal
import subprocess
import sys
import textwrap
import time

import pytest

from cfr_jax.data.worker_pool import open_pool

FEW, MANY = 2, 5  # threads, processes


def own_process(number):
    """Picklable, as work for processes has to be."""
    return number, os.getpid()


def refuse(number):
    raise ValueError(f"number {number} is refused")


def die(number):
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize("workers", [FEW, MANY])
def test_results_belong_to_their_numbers_and_many_workers_are_processes(workers):
    with open_pool(workers, own_process) as submit:
        results = [submit(number) for number in range(12)]
        numbers, processes = zip(*(result.result() for result in results), strict=True)

    assert numbers == tuple(range(12))
    assert (set(processes) == {os.getpid()}) == (workers == FEW)
    for process in set(processes) - {os.getpid()}:
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)


@pytest.mark.parametrize("workers", [FEW, MANY])
def test_an_error_of_the_work_is_raised_where_its_result_is_asked_for(workers):
    with (
        pytest.raises(ValueError, match="number 3 is refused"),
        open_pool(workers, refuse) as submit,
    ):
        submit(3).result()


def test_work_that_cannot_be_copied_is_refused_only_for_processes():
    with open_pool(FEW, lambda number: -number) as submit:
        assert submit(3).result() == -3
    with (
        pytest.raises(ValueError, match="workers: got 5, wanted at most 4 here"),
        open_pool(MANY, lambda number: -number) as submit,
    ):
        submit(3)


def test_a_worker_that_was_killed_is_reported_in_words():
    with (
        pytest.raises(RuntimeError, match="one of 5 processes .* was killed"),
        open_pool(MANY, die) as submit,
    ):
        submit(0).result()


PARENT = """
    import os, sys, time
    from cfr_jax.data.worker_pool import open_pool

    if __name__ == "__main__":
        with open_pool(5, abs) as submit:
            submit(-1).result()
            import multiprocessing
            print(*(child.pid for child in multiprocessing.active_children()), flush=True)
            time.sleep(600)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_no_worker_outlives_a_killed_parent(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(textwrap.dedent(PARENT))
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True) as parent:
        children = [int(word) for word in parent.stdout.readline().split()]
        parent.kill()

    assert children
    limit = time.monotonic() + 60
    while any(map(is_running, children)):
        assert time.monotonic() < limit, "a worker still runs"
        time.sleep(0.05)


def is_running(process):
    """Whether a process is there, and not just waiting to be reaped."""
    try:
        with open(f"/proc/{process}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False
