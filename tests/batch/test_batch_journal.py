"""The journal of a batch: nothing lost, nothing twice, nobody else's file harmed."""

from __future__ import annotations

import json
import socket
import subprocess
import sys

import jax
import pytest

from cfr_jax.batch.journal import Journal
from cfr_jax.batch.sharding import Shard, other_shards, parse_shard, process_shard

MADE_WITH = {"weights": "a" * 64, "seed": 0}


def record(source, error=None, repeat=0):
    return {"source": source, "target": "t", "repeat": repeat, "error": error}


def lines_of(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_what_was_written_is_there_when_it_is_opened_again(tmp_path):
    with Journal(tmp_path / "j", MADE_WITH) as journal:
        journal.write(record("a"))
        journal.write(record("a", repeat=1))
    with Journal(tmp_path / "j", MADE_WITH) as journal:
        assert list(journal.done) == [("a", "t", 0), ("a", "t", 1)]
    assert len(lines_of(tmp_path / "j")) == 3


@pytest.mark.parametrize("cut", range(1, 30, 7))
def test_a_line_that_a_kill_cut_short_is_taken_off(cut, tmp_path):
    # given
    path = tmp_path / "j"
    with Journal(path, MADE_WITH) as journal:
        journal.write(record("a"))
        whole = path.read_bytes()
        journal.write(record("b"))
    path.write_bytes(path.read_bytes()[: len(whole) + cut])

    # when
    with Journal(path, MADE_WITH) as journal:
        assert list(journal.done) == [("a", "t", 0)]
        journal.write(record("c"))

    # then
    assert [line.get("source") for line in lines_of(path)] == [None, "a", "c"]


@pytest.mark.parametrize("cut", [0, 1, 20])
def test_a_kill_within_the_first_line_is_a_fresh_start(cut, tmp_path):
    path = tmp_path / "j"
    Journal(path, MADE_WITH).close()
    path.write_bytes(path.read_bytes()[:cut])

    with Journal(path, MADE_WITH) as journal:
        journal.write(record("a"))

    assert len(lines_of(path)) == 2


@pytest.mark.parametrize("content", [b"my notes", b"my notes\n", b'{"a": 1}\n{"b": 2}\nhalf'])
def test_a_file_that_is_no_journal_is_refused_and_left_as_it_is(content, tmp_path):
    (tmp_path / "j").write_bytes(content)
    with pytest.raises(ValueError, match="is damaged|is not a journal"):
        Journal(tmp_path / "j", MADE_WITH)
    assert (tmp_path / "j").read_bytes() == content


def test_answers_made_with_other_settings_are_refused_by_the_name_of_the_setting(tmp_path):
    Journal(tmp_path / "j", MADE_WITH).close()
    with pytest.raises(ValueError, match="seed 0, not 1\n.*same options"):
        Journal(tmp_path / "j", MADE_WITH | {"seed": 1})


def test_two_at_once_are_one_too_many(tmp_path):
    with Journal(tmp_path / "j", MADE_WITH):
        with pytest.raises(ValueError, match="another `cfr batch`"):
            Journal(tmp_path / "j", MADE_WITH)
    Journal(tmp_path / "j", MADE_WITH).close()


def test_failed_pairs_are_tried_again_when_asked_for(tmp_path):
    path = tmp_path / "j"
    with Journal(path, MADE_WITH) as journal:
        journal.write(record("good"))
        journal.write(record("bad", error="is empty"))

    with Journal(path, MADE_WITH, retry=True) as journal:
        assert [key[0] for key in journal.done] == ["good"]
        journal.write(record("bad"))
    with Journal(path, MADE_WITH) as journal:
        assert journal.done["bad", "t", 0]["error"] is None


def test_a_damaged_line_is_named(tmp_path):
    with Journal(tmp_path / "j", MADE_WITH) as journal:
        journal.write(record("a"))
    path = tmp_path / "j"
    path.write_bytes(path.read_bytes().replace(b'"source"', b"source") + b"{}\n")
    with pytest.raises(ValueError, match="line 2 is damaged"):
        Journal(path, MADE_WITH)


@pytest.mark.parametrize("count", [1, 3, 7])
def test_shards_share_the_list_out_without_rest(count):
    shares = [list(range(20))[Shard(number, count).rows()] for number in range(1, count + 1)]
    assert sorted(sum(shares, [])) == list(range(20))
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


def test_a_shard_is_read_from_text():
    assert parse_shard("2/4") == Shard(2, 4)
    for wrong in ("0/4", "5/4", "2", "2/0", "a/b", "-1/3"):
        with pytest.raises(ValueError, match="wanted I/N"):
            parse_shard(wrong)


def test_shards_are_found_beside_the_whole(tmp_path):
    whole = tmp_path / "results.jsonl"
    parts = [Shard(number, 2).beside(whole) for number in (1, 2)]
    for path in (*parts, whole, tmp_path / "other.1-of-2.jsonl"):
        path.touch()
    assert other_shards(whole) == parts


def test_processes_of_a_cluster_share_the_list(monkeypatch):
    assert process_shard() is None
    monkeypatch.setattr(jax.distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(jax, "process_index", lambda: 2)
    monkeypatch.setattr(jax, "process_count", lambda: 5)
    assert process_shard() == Shard(3, 5)


_MEMBER = """
import sys, jax
from cfr_jax.batch.sharding import process_shard
jax.distributed.initialize(sys.argv[1], 2, int(sys.argv[2]))
print(*process_shard())
"""


@pytest.mark.slow
def test_two_processes_of_jax_distributed_know_their_shares():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        place = f"127.0.0.1:{free.getsockname()[1]}"
    members = [
        subprocess.Popen(
            [sys.executable, "-c", _MEMBER, place, str(number)], stdout=subprocess.PIPE, text=True
        )
        for number in (0, 1)
    ]
    assert [member.communicate(timeout=120)[0].split() for member in members] == [
        ["1", "2"],
        ["2", "2"],
    ]
