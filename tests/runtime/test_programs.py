"""Lowered programs that are kept between processes give the same results and are never stale."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import solids
from flax import struct

from cfr_jax import align, align_many
from cfr_jax.runtime import programs


@struct.dataclass
class Answer:
    """The result of the program under test."""

    total: jax.Array
    each: dict


programs.storable(Answer)


TRACED = []


@jax.jit
def program(numbers, weights):
    TRACED.append(1)
    return Answer(jnp.sum(numbers * weights["scale"]), {"doubled": 2 * numbers})


NUMBERS, WEIGHTS = jnp.arange(4.0), {"scale": jnp.float32(3)}


def call(function=program):
    """Runs it as a new process would: only what is in the folder is remembered."""
    programs._program.cache_clear()
    function.clear_cache()
    TRACED.clear()
    return programs.compiled(function, NUMBERS, WEIGHTS)(NUMBERS, WEIGHTS)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(programs, "_places", [])
    programs.keep_in(tmp_path)
    yield tmp_path
    programs._program.cache_clear()


def assert_right(answer):
    assert isinstance(answer, Answer)
    assert answer.total == 18
    np.testing.assert_array_equal(answer.each["doubled"], 2 * NUMBERS)


def test_a_kept_program_is_not_traced_again(folder):
    assert_right(call())
    assert TRACED

    assert_right(call())

    assert not TRACED
    assert len(list(folder.rglob("*.stablehlo"))) == 1


@pytest.mark.parametrize("left", [0, 1, 32, 100, -1])
@pytest.mark.parametrize("flipped", [False, True], ids=["cut off", "one bit flipped"])
def test_a_damaged_program_is_made_again(folder, left, flipped):
    call()
    (path,) = folder.rglob("*.stablehlo")
    content = bytearray(path.read_bytes())
    if flipped:
        content[left] ^= 1
    else:
        del content[left:]
    path.write_bytes(content)

    assert_right(call())

    assert TRACED


def test_each_version_keeps_its_own_programs(folder, monkeypatch):
    call()
    monkeypatch.setattr(jax, "__version__", "other")
    programs.keep_in(folder)

    assert_right(call())

    assert TRACED
    assert len(list(folder.rglob("*.stablehlo"))) == 2


def test_only_programs_unused_for_a_month_are_deleted(folder, monkeypatch):
    call()
    (old,) = folder.rglob("*.stablehlo")
    mine = folder / "programs-mine" / "thesis.stablehlo"
    beside = old.with_name("notes.txt")
    mine.parent.mkdir()
    for path in (old, mine, beside):
        path.touch()
        os.utime(path, (0, 0))
    monkeypatch.setattr(jax, "__version__", "other")
    programs.keep_in(folder)

    call()

    assert not old.exists()
    assert mine.exists() and beside.exists()


def test_functions_that_share_a_name_are_not_mixed_up(folder):
    double, triple = jax.jit(lambda n, w: 2 * n.sum()), jax.jit(lambda n, w: 3 * n.sum())

    assert (call(double), call(triple)) == (12, 18)


@struct.dataclass
class Unknown:
    """A result type that was not registered."""

    value: jax.Array


@jax.jit
def unknown(numbers, weights):
    TRACED.append(1)
    return Unknown(numbers.sum())


def test_a_program_that_cannot_be_kept_is_still_compiled(folder):
    assert call(unknown).value == 6
    assert TRACED == [1]
    assert not list(folder.rglob("*.stablehlo"))


def test_all_programs_of_the_command_line_can_be_kept(folder):
    source, target = (solids.lopsided(60, seed, 0.003).points for seed in (0, 1))

    align(source, target, initial="global")
    list(align_many([(source, target)]))

    kept = {path.name.split("-")[0] for path in folder.rglob("*.stablehlo")}
    # "judged" runs only if an answer comes from the start, not from the network
    assert kept - {"judged"} == {
        "propose", "polish", "solve_pair", "refined_start", "encode_target", "solve_many"
    }  # fmt: skip


def test_a_folder_that_cannot_be_written_costs_only_time(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setattr(programs, "_places", [])
    programs.keep_in(tmp_path / "file")

    assert_right(call())
    programs._program.cache_clear()


_RACING = """
import sys
from pathlib import Path
import jax, jax.numpy as jnp, numpy as np
from cfr_jax.runtime import programs
from cfr_jax.geometry import rigid
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
programs.keep_in(Path(sys.argv[1]))
motions = jnp.asarray(np.random.default_rng(0).normal(size=(4, 4)), jnp.float32)
compose = jax.jit(rigid.compose)
compose.__module__ = rigid.compose.__module__
print(np.asarray(programs.compiled(compose, motions, motions)(motions, motions)).tobytes().hex())
"""


@pytest.mark.slow
def test_processes_that_race_on_a_cold_cache_give_the_same_bits(tmp_path):
    # given
    paths = os.pathsep.join(filter(None, sys.path))
    racing = [
        subprocess.Popen(
            [sys.executable, "-c", _RACING, str(tmp_path / "cache")],
            stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": paths},
        )
        for _ in range(4)
    ]  # fmt: skip

    # when
    told = [process.communicate(timeout=300)[0] for process in racing]

    # then
    assert [process.returncode for process in racing] == [0] * 4
    assert len(set(told)) == 1 and told[0].strip()
    assert len(list((tmp_path / "cache").glob("programs-*/*.stablehlo"))) == 1
    assert not list(tmp_path.rglob("*.tmp"))
