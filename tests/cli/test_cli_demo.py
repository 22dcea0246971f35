"""`cfr demo`: the pair that ships, its truth, its pictures."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cli_samples
import numpy as np
import pytest

import cfr_jax
from cfr_jax import io
from cfr_jax.cli import demo, main

PAIR = Path(cfr_jax.__file__).parent / "cli" / "demo_pair"


def test_the_errors_are_those_of_a_known_error():
    # given: ten degrees about an axis through the origin, and a step of 0.5
    estimate, truth = cli_samples.motion(30.0), cli_samples.motion(20.0)
    estimate[:3, 3] = truth[:3, 3] + [0.3, 0.0, 0.4]

    # when
    words = demo.errors_in_words(estimate, truth, np.zeros((4, 3)))

    # then
    assert words == {
        "error": "10.00° in rotation, 0.5000 m in translation",
        "points off": "0.5000 m on average",
    }


def test_the_pair_that_ships_overlaps_under_its_truth():
    # given
    source, target = (io.read(PAIR / f"{name}.ply").points for name in ("source", "target"))
    transform = np.array(json.loads((PAIR / "truth.json").read_text())["transform"])

    # when
    from scipy.spatial import cKDTree

    moved = source @ transform[:3, :3].T + transform[:3, 3]
    distances, _ = cKDTree(target).query(moved)
    radius = np.linalg.norm(target - target.mean(axis=0), axis=1).max()

    # then
    assert np.mean(distances < 0.05 * radius) > 0.5


def test_the_demo_finds_the_true_motion_and_draws_it(tmp_path, capsys):
    # when
    code = main(["demo", "--out", str(tmp_path / "made" / "here")])

    # then
    out = capsys.readouterr().out
    [angle] = re.findall(r"^error +([\d.]+)° in rotation", out, re.MULTILINE)
    assert code == 0 and float(angle) < 5.0
    assert re.search(r"^verdict +trusted$", out, re.MULTILINE)
    for name in ("demo.html", "demo.png"):
        assert str(tmp_path / "made" / "here" / name) in out
        assert (tmp_path / "made" / "here" / name).stat().st_size > 10_000


def test_without_matplotlib_the_demo_leaves_the_picture_out(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("cfr_jax.cli.shared.outputs.can_draw", lambda: False)
    assert main(["demo", "--out", str(tmp_path)]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["demo.html"]
    assert 'pip install "cfr_jax[viz]"' in capsys.readouterr().out


@pytest.mark.parametrize("place", ["file", "file/below"])
def test_a_folder_that_cannot_be_made_is_told(place, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(["demo", "--out", str(tmp_path / place)]) == 2
    assert capsys.readouterr().err.count("\n") <= 3


def test_the_demo_merges_its_views_into_one_model(tmp_path, capsys):
    # when
    code = main(["demo", "--merge", "--out", str(tmp_path)])

    # then
    out = capsys.readouterr().out
    [angle] = re.findall(r"^error +([\d.]+)° at most", out, re.MULTILINE)
    assert code == 0 and float(angle) < 1.0
    assert re.search(r"^placed +8 of 8 scans$", out, re.MULTILINE)
    assert len(io.read(tmp_path / "model.ply")) > 3000
    assert "view7.ply" in (tmp_path / "model.html").read_text()
