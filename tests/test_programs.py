"""Lowered programs that are kept between processes: the same answers, and nothing that is stale."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from cfr_jax import programs


@struct.dataclass
class Answer:
    """What the program under test answers."""

    total: jax.Array
    each: dict


programs.storable(Answer)


def make(traced):
    @jax.jit
    def program(numbers, weights):
        traced.append(1)
        return Answer(jnp.sum(numbers * weights["scale"]), {"doubled": 2 * numbers})

    return program


NUMBERS, WEIGHTS = jnp.arange(4.0), {"scale": jnp.float32(3)}


def call(program):
    """As a process of its own would: nothing is remembered but what lies in the folder."""
    programs._program.cache_clear()
    return programs.compiled(program, NUMBERS, WEIGHTS)(NUMBERS, WEIGHTS)


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
    first, second = [], []

    assert_right(call(make(first)))
    assert_right(call(make(second)))

    assert (len(first), len(second)) == (1, 0)
    assert len(list(folder.rglob("*.stablehlo"))) == 1


@pytest.mark.parametrize("left", [0, 1, 32, 100, -1])
@pytest.mark.parametrize("flipped", [False, True], ids=["cut off", "one bit flipped"])
def test_a_damaged_one_is_made_again(folder, left, flipped):
    call(make([]))
    (path,) = folder.rglob("*.stablehlo")
    content = bytearray(path.read_bytes())
    if flipped:
        content[left] ^= 1
    else:
        del content[left:]
    path.write_bytes(content)
    traced = []

    assert_right(call(make(traced)))

    assert traced


def test_other_versions_keep_their_own_and_the_old_ones_go(folder, monkeypatch):
    call(make([]))
    monkeypatch.setattr(jax, "__version__", "other")
    programs.keep_in(folder)
    traced = []

    assert_right(call(make(traced)))

    assert traced
    assert len(list(folder.glob("programs-*"))) == 1


def test_what_cannot_be_kept_is_compiled_all_the_same(folder):
    @struct.dataclass
    class Unknown:
        value: jax.Array

    program = jax.jit(lambda numbers, weights: Unknown(numbers.sum()))

    assert call(program).value == 6
    assert not list(folder.rglob("*.stablehlo"))


def test_a_folder_that_cannot_be_written_costs_time_and_nothing_else(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setattr(programs, "_places", [])
    programs.keep_in(tmp_path / "file")

    assert_right(call(make([])))
    programs._program.cache_clear()
