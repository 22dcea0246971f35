"""Lowered programs that are kept between processes give the same results and are never stale."""

import os

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
    assert kept == {"propose", "polish", "solve_pair", "encode_target", "solve_many"}


def test_a_folder_that_cannot_be_written_costs_only_time(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setattr(programs, "_places", [])
    programs.keep_in(tmp_path / "file")

    assert_right(call())
    programs._program.cache_clear()
