"""`cfr batch`: a table whatever happens on the way. The answers themselves: `test_batch`."""

from __future__ import annotations

import csv
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import batch_samples
import jsonschema
import pytest

from cfr_jax.batch import records, stream
from cfr_jax.batch.jobs import Job
from cfr_jax.cli import main

TESTS = Path(__file__).parents[1]
SCHEMA = json.loads((TESTS.parent / "cfr_jax/cli/schemas/batch.schema.json").read_text())


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Answers at once, and notes which files it was given."""
    asked = []

    def align_many(pairs, **options):
        pairs = list(pairs)
        asked.extend(os.path.basename(pair[0]) for pair in pairs if not callable(pair))
        return batch_samples.quick(pairs, **options)

    monkeypatch.setattr(stream, "align_many", align_many)
    monkeypatch.setenv("CFR_JAX_CACHE", "off")
    return asked


def run(folder, *arguments, out="results.csv"):
    return main(["batch", str(folder), "--out", str(Path(folder).parent / out), *arguments])


def table(path):
    with open(path, newline="") as stream_:
        return list(csv.DictReader(stream_))


def lines(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_a_list_becomes_a_table_in_its_order(tmp_path, capsys):
    # given a list with a file that is empty
    listed = batch_samples.write_pairs(tmp_path, 4)
    (tmp_path / "s2.ply").write_bytes(b"")

    # when
    code = run(listed)

    # then
    rows = table(tmp_path / "results.csv")
    assert code == 0 and [row["source"] for row in rows] == [f"s{i}.ply" for i in range(4)]
    assert [row["status"] for row in rows] == ["ok", "ok", "failed", "ok"]
    assert "s2.ply: is empty" in rows[2]["remarks"] and rows[2]["t00"] == ""
    wanted = batch_samples.answered(0).alignment.transform
    assert [[float(rows[0][f"t{i}{j}"]) for j in range(4)] for i in range(4)] == wanted.tolist()
    out, err = capsys.readouterr()
    assert "recognized" in out and "a list of" in out and "s2.ply" in out
    assert "\r" not in err and "registering: 4 of 4 pairs" in err and "1 failed" in err


def test_every_line_of_the_journal_is_as_the_schema_says(tmp_path):
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    validator = jsonschema.Draft202012Validator(SCHEMA)
    listed = batch_samples.write_pairs(tmp_path, 2)
    (tmp_path / "s1.ply").write_bytes(b"")

    run(listed)

    found = lines(tmp_path / "results.jsonl")
    for line in found:
        validator.validate(line)
    assert len(found) == 3
    for wrong in ({"confidence": 2.0}, {"transform": [[1.0]]}, {"error": 3}):
        with pytest.raises(jsonschema.ValidationError):
            validator.validate(found[1] | wrong)


@pytest.mark.parametrize("start", ["=", "+", "-", "@", "\t", "\r", "＝"])
def test_no_cell_of_the_table_is_run_by_a_spreadsheet(start, tmp_path):
    # given files and messages that begin as formulas do
    job = Job(f"{start}1+1", f"{start}cmd|' /C calc'!A0.ply", 0, (Path("a"), Path("b")))
    found = [
        records.as_record(job, stream.Outcome(0, None, f"{start}HYPERLINK(1)")),
        records.as_record(job, batch_samples.answered(0)),
    ]

    # when
    with open(tmp_path / "t.csv", "w", newline="") as file:
        records.write_table(file, found)

    # then
    rows = table(tmp_path / "t.csv")
    wanted = {"\t": "\\t1+1", "\r": "\\r1+1"}.get(start, f"'{start}1+1")
    assert [row["source"] for row in rows] == [wanted] * 2
    for row in rows:
        for name in ("source", "target", "status", "remarks"):
            assert not row[name].startswith(start)
    wanted = batch_samples.answered(0).alignment.transform
    assert [float(rows[1][f"t{i}3"]) for i in range(4)] == wanted[:, 3].tolist()


def test_the_same_command_again_does_nothing_twice(tmp_path, quick, capsys):
    listed = batch_samples.write_pairs(tmp_path, 3)
    run(listed)
    before = (tmp_path / "results.csv").read_bytes()
    del quick[:]

    code = run(listed)

    assert code == 0 and quick == []
    assert (tmp_path / "results.csv").read_bytes() == before
    assert "done before 3" in capsys.readouterr().out


def test_a_list_that_grew_is_done_where_it_grew(tmp_path, quick):
    listed = batch_samples.write_pairs(tmp_path, 3)
    run(listed)
    del quick[:]
    batch_samples.write_pairs(tmp_path, 5)

    run(listed)

    assert quick == ["s3.ply", "s4.ply"] and len(table(tmp_path / "results.csv")) == 5


def test_failed_pairs_are_tried_again_only_when_asked_for(tmp_path, quick):
    listed = batch_samples.write_pairs(tmp_path, 3)
    good = (tmp_path / "s1.ply").read_bytes()
    (tmp_path / "s1.ply").write_bytes(b"")
    run(listed)
    (tmp_path / "s1.ply").write_bytes(good)
    del quick[:]

    run(listed)
    assert quick == [] and table(tmp_path / "results.csv")[1]["status"] == "failed"
    run(listed, "--retry-failed")
    assert quick == ["s1.ply"] and table(tmp_path / "results.csv")[1]["status"] == "ok"


def test_a_pair_that_is_listed_twice_has_two_rows(tmp_path):
    listed = batch_samples.write_pairs(tmp_path, 1)
    listed.write_text("s0.ply,t0.xyz\n" * 2)
    run(listed)
    assert len(table(tmp_path / "results.csv")) == 2
    assert [line["repeat"] for line in lines(tmp_path / "results.jsonl")[1:]] == [0, 1]


def test_shards_add_up_to_the_whole_table(tmp_path, quick):
    listed = batch_samples.write_pairs(tmp_path, 5)
    for shard in ("1/2", "2/2"):
        assert run(listed, "--shard", shard) == 0
    assert len(table(tmp_path / "results.1-of-2.csv")) == 3
    assert sorted(quick) == [f"s{i}.ply" for i in range(5)]
    del quick[:]

    run(listed)

    assert quick == [] and len(table(tmp_path / "results.csv")) == 5


def test_all_points_are_used_unless_told_otherwise_and_the_journal_knows(
    tmp_path, monkeypatch, capsys
):
    listed, asked = batch_samples.write_pairs(tmp_path, 2), []

    def align_many(pairs, **options):
        asked.append(options["all_points"])
        return batch_samples.quick(list(pairs), **options)

    monkeypatch.setattr(stream, "align_many", align_many)

    assert run(listed) == 0 and run(listed, "--thinned", out="thinned.csv") == 0
    assert asked == [True, False]
    assert run(listed, "--thinned") == 2
    assert "all_points True, not False" in capsys.readouterr().err


def test_strict_tells_that_a_pair_failed(tmp_path):
    listed = batch_samples.write_pairs(tmp_path, 2)
    assert run(listed, "--strict") == 0
    (tmp_path / "s0.ply").write_bytes(b"")
    assert run(listed, "--strict", out="other.csv") == 3


def test_an_interruption_says_how_to_go_on_and_loses_nothing(tmp_path, monkeypatch, capsys, quick):
    # given
    def interrupted(pairs, **options):
        yield from list(batch_samples.quick(pairs))[:2]
        raise KeyboardInterrupt

    listed = batch_samples.write_pairs(tmp_path, 4)
    with monkeypatch.context() as patch:
        patch.setattr(stream, "align_many", interrupted)

        # when
        code = run(listed)

    # then
    err = capsys.readouterr().err
    assert code == 130 and "results.jsonl keeps what is done" in err and "Traceback" not in err
    assert not (tmp_path / "results.csv").exists()
    run(listed)
    assert quick == ["s2.ply", "s3.ply"] and len(table(tmp_path / "results.csv")) == 4


_SLOW = """
import sys, time
sys.path.insert(0, sys.argv.pop(1))
import batch_samples
from cfr_jax.batch import stream
def slow(pairs, **options):
    for outcome in batch_samples.quick(pairs):
        yield outcome
        time.sleep(0.3)
stream.align_many = slow
from cfr_jax.cli import main
sys.exit(main(sys.argv[1:]))
"""


def test_a_kill_loses_nothing_and_no_pair_is_done_twice(tmp_path, quick):
    # given a command that is killed in the middle
    listed = batch_samples.write_pairs(tmp_path, 40)
    kept = tmp_path / "results.jsonl"
    command = [sys.executable, "-c", _SLOW, str(TESTS), "batch", str(listed), "--out"]
    child = subprocess.Popen(
        [*command, str(tmp_path / "results.csv")], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    deadline = time.monotonic() + 120
    while not (kept.exists() and kept.read_bytes().count(b"\n") > 3):
        assert time.monotonic() < deadline and child.poll() is None, child.communicate()
        time.sleep(0.05)
    os.kill(child.pid, signal.SIGKILL)
    child.communicate()
    done = [line["source"] for line in lines(kept)[1:]]
    with open(kept, "ab") as stream_:  # a kill may come within a line
        stream_.write(b'{"source": "s39.ply", "tar')

    # when
    code = run(listed)

    # then
    assert code == 0 and 0 < len(done) < 40
    assert quick == [f"s{i}.ply" for i in range(len(done), 40)]
    names = [line["source"] for line in lines(kept)[1:]]
    assert sorted(names) == sorted({f"s{i}.ply" for i in range(40)})
    assert len(table(tmp_path / "results.csv")) == 40


@pytest.mark.slow
def test_thirty_kills_at_random_moments_leave_the_same_bytes(tmp_path):
    # given a batch that nothing disturbed
    listed = batch_samples.write_pairs(tmp_path, 200)
    command = [sys.executable, "-c", _SLOW.replace("0.3", "0.05"), str(TESTS), "batch", str(listed)]
    assert run(listed, out="whole.csv") == 0

    # when another one is killed again and again, each time after some more pairs
    chance, kept = random.Random(0), tmp_path / "killed.jsonl"
    for kill in range(30):
        before = kept.stat().st_size if kept.exists() else 0
        child = subprocess.Popen(
            [*command, "--out", str(tmp_path / "killed.csv")],
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        )  # fmt: skip
        deadline = time.monotonic() + 120
        while not (kept.exists() and kept.stat().st_size > before):
            assert time.monotonic() < deadline and child.poll() is None, (kill, child.communicate())
            time.sleep(0.01)
        time.sleep(chance.uniform(0, 0.1))
        child.kill()
        child.communicate()
    assert not (tmp_path / "killed.csv").exists(), "killed too late to tell"
    assert run(listed, out="killed.csv") == 0

    # then
    assert (tmp_path / "killed.csv").read_bytes() == (tmp_path / "whole.csv").read_bytes()
    assert len(lines(kept)) == 1 + 200


def test_columns_are_named_once():
    assert len(set(records.COLUMNS)) == len(records.COLUMNS) == 28
