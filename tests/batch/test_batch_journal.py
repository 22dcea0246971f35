"""The journal of a batch: nothing lost, nothing twice, nobody else's file harmed."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import socket
import subprocess
import sys

import jax
import pytest

from cfr_jax.batch.checked_lines import line_of
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
        assert list(journal) == [("a", "t", 0), ("a", "t", 1)]
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
        assert list(journal) == [("a", "t", 0)]
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
        assert [key[0] for key in journal] == ["good"]
        journal.write(record("bad"))
    with Journal(path, MADE_WITH) as journal:
        assert journal["bad", "t", 0]["error"] is None


def test_a_damaged_line_is_named(tmp_path):
    with Journal(tmp_path / "j", MADE_WITH) as journal:
        journal.write(record("a"))
    path = tmp_path / "j"
    path.write_bytes(path.read_bytes().replace(b'"source"', b"source") + b"{}\n")
    with pytest.raises(ValueError, match="line 2 is damaged"):
        Journal(path, MADE_WITH)


def test_any_changed_bit_of_a_whole_line_is_refused_and_the_lock_is_free_again(tmp_path):
    # given
    path = tmp_path / "j"
    with Journal(path, MADE_WITH) as journal:
        for name in ("a", "b", "c"):
            journal.write(record(name) | {"transform": [[0.25, 1e-300], [-3.5, 7.0]]})
    whole = path.read_bytes()

    # every third bit, and not those of the last line break: a line that is cut is taken off
    for bit in range(0, 8 * (len(whole) - 1), 3):
        # when
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)

        # then
        with pytest.raises(ValueError, match="is damaged|or damaged|another version"):
            Journal(path, MADE_WITH)
        assert path.read_bytes() == damaged
    path.write_bytes(whole)
    with Journal(path, MADE_WITH) as journal:
        assert [key[0] for key in journal] == ["a", "b", "c"]


def test_a_line_changed_after_it_was_read_is_refused_when_it_is_read_again(tmp_path):
    path = tmp_path / "j"
    with Journal(path, MADE_WITH) as journal:
        journal.write(record("a") | {"fitness": 0.25})
        assert journal["a", "t", 0]["fitness"] == 0.25
        path.write_bytes(path.read_bytes().replace(b"0.25", b"0.95"))
        with pytest.raises(ValueError, match="is damaged .*checksum"):
            journal["a", "t", 0]


@pytest.mark.parametrize(
    "value", [[], 3, {}, {"source": "a"}, record(3), record("a", repeat="b"), record("a", error=1)]
)
def test_a_line_with_a_checksum_that_is_no_record_is_named(value, tmp_path):
    path = tmp_path / "j"
    Journal(path, MADE_WITH).close()
    bare = json.dumps(value).encode() if isinstance(value, dict) else b"[1, 2}"
    line = line_of(value) if isinstance(value, dict) and value else bare + b"\n"
    path.write_bytes(path.read_bytes() + line)
    with pytest.raises(ValueError, match="line 2 is damaged"):
        Journal(path, MADE_WITH)


def test_a_checksum_is_what_the_schema_says():
    line = line_of({"a": 1}).decode()
    held = json.loads(line)
    bare = line.rstrip("\n").replace(f', "check": "{held["check"]}"', "")
    assert held["check"] == hashlib.sha256(bare.encode()).hexdigest()[:16]


def test_a_journal_of_an_older_version_is_told_apart(tmp_path):
    header = {"format": "cfr_jax/batch/1", "made_with": MADE_WITH}
    (tmp_path / "j").write_text(json.dumps(header) + "\n")
    with pytest.raises(ValueError, match="is a journal of another version\nmove it"):
        Journal(tmp_path / "j", MADE_WITH)


@pytest.mark.parametrize("change", ["removed", "folder removed", "replaced"])
def test_a_journal_that_is_taken_away_meanwhile_is_noticed_at_the_next_write(change, tmp_path):
    # given
    folder = tmp_path / "out"
    folder.mkdir()
    path = folder / "j"
    with Journal(path, MADE_WITH) as journal:
        journal.write(record("a"))

        # when
        if change == "folder removed":
            shutil.rmtree(folder)
        elif change == "removed":
            path.unlink()
        else:
            path.rename(folder / "old")
            path.write_text("new")

        # then
        with pytest.raises(OSError, match="j can no longer be written .*\n.*goes on from"):
            journal.write(record("b"))


def test_a_full_disk_is_told_with_the_file_and_leaves_whole_lines(tmp_path, monkeypatch):
    path = tmp_path / "j"
    with Journal(path, MADE_WITH) as journal:
        journal.write(record("a"))
        write, room = os.write, [30]

        def full(file, data):
            if not room[0]:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            done = write(file, data[: room[0]])
            room[0] -= done
            return done

        monkeypatch.setattr(os, "write", full)
        with pytest.raises(OSError, match="j can no longer be .*No space left.*\n.*goes on"):
            journal.write(record("b"))
        monkeypatch.undo()
    with Journal(path, MADE_WITH) as journal:
        assert [key[0] for key in journal] == ["a"]


@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_a_journal_that_is_no_file_is_refused(kind, tmp_path):
    path = tmp_path / "j"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.mkdir()
    with pytest.raises(ValueError, match="is not a regular file|cannot be opened"):
        Journal(path, MADE_WITH)
    with Journal(tmp_path / "mine", MADE_WITH) as journal:
        with pytest.raises(ValueError, match="is not a regular file|is a folder"):
            journal.adopt(path, MADE_WITH)


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
