"""`--columns`, words on what was read by a rule, and `--out` with all that the source holds."""

from __future__ import annotations

import json
from argparse import Namespace
from pathlib import Path

import cli_samples
import numpy as np
import pytest

from cfr_jax import io
from cfr_jax.cli import main
from cfr_jax.cli.shared import report
from cfr_jax.weights import files
from cfr_jax.weights.files import Weights

POINTS = cli_samples.points(300, 0)
MOTION = cli_samples.motion()
TIMES = np.arange(300) * 0.5


@pytest.fixture
def given(tmp_path, monkeypatch):
    """A folder with two clouds as text, and the clouds that `align` is given; answers cost
    nothing."""
    clouds = []

    def align(source, target, **options):
        clouds.append((source, target))
        return cli_samples.alignment(source, target)

    monkeypatch.setattr(report, "align", align)
    monkeypatch.setattr(files, "read_weights", lambda *_: Weights({}, "w", "cfr", "0" * 64, {}))
    monkeypatch.chdir(tmp_path)
    np.savetxt("timed.txt", np.c_[TIMES, POINTS])
    np.savetxt("bright.txt", np.c_[POINTS + 1, TIMES % 7])
    return clouds


def test_columns_are_named_once_for_both_or_one_by_one(given):
    command = ["register", "timed.txt", "timed.txt", "--columns", "time,x,y,z", "--json", "a.json"]
    assert main(command) == 0
    command[2:] = ["bright.txt", "--columns", "time x y z", "--columns", "-"]
    assert main(command) == 0
    command[1:3] = ["bright.txt", "timed.txt"]
    command[3:] = ["--columns", "-", "--columns", "time,x,y,z"]
    assert main(command) == 0

    wanted = [(POINTS, POINTS), (POINTS, POINTS + 1), (POINTS + 1, POINTS)]
    for found, pair in zip(given, wanted, strict=True):
        for cloud, points in zip(found, pair, strict=True):
            np.testing.assert_allclose(cloud.points, points, atol=1e-12)
    document = json.loads(Path("a.json").read_text())
    assert document["source"]["columns"] == ["time", "x", "y", "z"]


def test_what_was_read_by_a_rule_is_told_once(given, capsys):
    assert main(["register", "bright.txt", "bright.txt"]) == 0
    told = capsys.readouterr().err
    assert told.count("cfr register: warning: bright.txt: took the first three of 4 columns") == 1
    assert "--columns" in told


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        (["a,b"], "--columns: has no x and no y and no z among a, b"),
        (["-", "-", "-"], "--columns: given 3 times"),
        (["t,x,y,z,i"], "got 5 names"),
        ([], "column 1 grows from row to row"),
    ],
)
def test_columns_that_do_not_fit_are_refused(columns, said, given, capsys):
    options = [word for names in columns for word in ("--columns", names)]
    assert main(["register", "timed.txt", "timed.txt", *options]) == 2
    told = capsys.readouterr().err
    assert said in told and len(told.splitlines()) <= 3


@pytest.mark.parametrize("suffix", ["xyz", "csv", "ply", "pcd", "npy"])
def test_the_moved_source_keeps_its_columns(suffix, given):
    options = ["--columns", "time,x,y,z", "--out", f"moved.{suffix}"]
    assert main(["register", "timed.txt", "timed.txt", *options]) == 0

    columns = None if suffix in ("ply", "pcd") else "time,x,y,z"
    moved = io.read(f"moved.{suffix}", columns=columns, properties=True)
    wanted = POINTS @ MOTION[:3, :3].T + MOTION[:3, 3]
    np.testing.assert_allclose(moved.points, wanted, atol=1e-6)
    np.testing.assert_array_equal(moved.table.values[0], TIMES)


def test_what_the_format_cannot_hold_is_told(given, capsys):
    rows = "".join("{},{},{},oak\n".format(*point) for point in POINTS)
    Path("trees.csv").write_text("x,y,z,kind\n" + rows)
    assert main(["register", "trees.csv", "trees.csv", "--out", "moved.ply"]) == 0
    assert "warning: moved.ply: left out kind: PLY holds numbers" in capsys.readouterr().err


def test_batches_read_with_the_columns_too(tmp_path):
    from cfr_jax.cli.shared import clouds

    arguments = Namespace(columns=["time,x,y,z", "-"])
    np.savetxt(tmp_path / "timed.txt", np.c_[TIMES, POINTS])
    io.write(tmp_path / "target.ply", io.PointCloud(POINTS + 1))
    pairs = [(tmp_path / "timed.txt", tmp_path / "target.ply")] * 2

    first, second = (make() for make in clouds.with_columns(pairs, arguments))

    np.testing.assert_allclose(first[0].points, POINTS, atol=1e-12)
    np.testing.assert_array_equal(first[1].points, POINTS + 1)
    assert first[1] is second[1]  # so that a target of many sources is prepared once
    with pytest.raises(ValueError, match="--columns: these data say themselves"):
        list(clouds.with_columns([lambda: None], arguments))
