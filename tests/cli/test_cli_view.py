"""`cfr view`: a saved result is drawn as it was, or refused with the way out."""

from __future__ import annotations

import importlib.util
import json
import shutil
from pathlib import Path

import cli_samples
import numpy as np
import pytest

from cfr_jax import io
from cfr_jax.cli import main
from cfr_jax.cli.shared import report, saved
from cfr_jax.weights.files import Weights


@pytest.fixture
def result(tmp_path) -> report.Result:
    """A registration of two files in `tmp_path`; its document lies beside them."""
    paths = cli_samples.write_pair(tmp_path)
    source, target = (io.read(path) for path in paths)
    found = cli_samples.alignment(source, target, warnings=("small clouds",))
    answer = report.Result(
        source, target, cli_samples.motion(3.0), 0, Weights({}, "w", "cfr", "0" * 64, {}), found
    )
    document = report.as_document(answer, *paths)
    (tmp_path / "result.json").write_text(json.dumps(document))
    return answer


def change(path: Path, **fields) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


def test_a_saved_result_is_the_scene_that_was_there_but_for_the_weights(result, tmp_path):
    # given
    document = saved.read_result(tmp_path / "result.json")

    # when
    scene = saved.as_scene(document, result.source, result.target)

    # then
    live = report.as_scene(result)
    for name in ("source", "target", "transforms"):
        np.testing.assert_array_equal(getattr(scene, name), getattr(live, name))
    for name in ("labels", "facts", "warnings", "source_name", "target_name"):
        assert getattr(scene, name) == getattr(live, name)
    assert scene.weights is None


def test_the_page_lies_beside_the_result_unless_told_otherwise(result, tmp_path, capsys):
    pytest.importorskip("matplotlib", reason="pictures need the viz extra")
    assert main(["view", str(tmp_path / "result.json")]) == 0
    assert "source.ply" in (tmp_path / "result.html").read_text()

    outs = [tmp_path / "page.htm", tmp_path / "picture.png"]
    options = [part for path in outs for part in ("--out", str(path))]
    assert main(["view", str(tmp_path / "result.json"), *options]) == 0
    assert outs[0].read_bytes() == (tmp_path / "result.html").read_bytes()
    assert outs[1].read_bytes().startswith(b"\x89PNG")
    assert "warning     small clouds" in capsys.readouterr().out


def test_a_result_of_weights_without_calibration_is_drawn(result, tmp_path):
    change(tmp_path / "result.json", confidence=None)

    document = saved.read_result(tmp_path / "result.json")
    scene = saved.as_scene(document, result.source, result.target)

    assert scene.facts["confidence"] == "unknown"
    assert main(["view", str(tmp_path / "result.json")]) == 0


def test_clouds_that_moved_together_with_the_result_are_found(result, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    for name in ("result.json", "source.ply", "target.xyz"):
        shutil.move(tmp_path / name, tmp_path / "elsewhere" / name)
    assert main(["view", str(tmp_path / "elsewhere" / "result.json")]) == 0
    assert (tmp_path / "elsewhere" / "result.html").exists()


def test_a_cloud_that_is_gone_is_named_with_the_option_that_finds_it(result, tmp_path, capsys):
    # given
    (tmp_path / "source.ply").rename(tmp_path / "renamed.ply")

    # when
    gone = main(["view", str(tmp_path / "result.json")])
    told = capsys.readouterr().err
    found = main(["view", str(tmp_path / "result.json"), "--source", str(tmp_path / "renamed.ply")])

    # then
    assert (gone, found) == (2, 0)
    assert "source.ply" in told and "--source FILE" in told and told.count("\n") <= 3


def test_a_file_with_other_points_is_refused(result, tmp_path, capsys):
    io.write(tmp_path / "source.ply", io.PointCloud(cli_samples.points(99, 0)))
    assert main(["view", str(tmp_path / "result.json")]) == 2
    assert "99 points, but the result was made from 700" in capsys.readouterr().err


def test_a_file_that_was_moved_in_space_is_shown_with_a_warning(result, tmp_path, capsys):
    cloud = io.read(tmp_path / "source.ply")
    io.write(tmp_path / "source.ply", io.PointCloud(cloud.points + 3.0))
    assert main(["view", str(tmp_path / "result.json")]) == 0
    assert "were the files changed?" in capsys.readouterr().out


BROKEN = [
    ("[1, 2]", "holds a list"),
    ("{}", "its format is None"),
    ('{"format": "cfr_jax/register/99"}', "its format is 'cfr_jax/register/99'"),
    ("{", "Expecting property name"),
    ("[" * 100_000, "wanted what `cfr register --json` wrote"),
]


@pytest.mark.parametrize(("text", "told"), BROKEN, ids=[told for _, told in BROKEN])
def test_what_is_no_result_is_refused(text, told, tmp_path, capsys):
    (tmp_path / "result.json").write_text(text)
    assert main(["view", str(tmp_path / "result.json")]) == 2
    err = capsys.readouterr().err
    assert "result.json" in err and told in err and err.count("\n") <= 3


@pytest.mark.parametrize(
    ("field", "value", "told"),
    [
        ("transform", "near", '"transform"'),
        ("transforms", [[[1, 0], [0, 1]]], "transforms"),
        ("transforms", None, '"transforms"'),
        ("source", {"name": "a"}, '"source" is'),
        ("confidence", [], '"confidence"'),
        ("inlier_distance", "far", '"inlier_distance"'),
    ],
)
def test_a_damaged_result_is_refused(field, value, told, result, tmp_path, capsys):
    change(tmp_path / "result.json", **{field: value})
    assert main(["view", str(tmp_path / "result.json")]) == 2
    err = capsys.readouterr().err
    assert told in err and err.count("\n") <= 3
    assert not (tmp_path / "result.html").exists()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--out", "page.pdf"], "wanted a name that ends in"),
        (["--out", "nowhere/page.html"], "no folder"),
        (["--out", "a.html", "--out", "a.html"], "written twice"),
    ],
)
def test_outputs_are_checked_first(options, told, result, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["view", "result.json", *options]) == 2
    assert told in capsys.readouterr().err


def test_a_missing_result_and_a_folder_are_refused(tmp_path, capsys):
    for path in (tmp_path / "none.json", tmp_path):
        assert main(["view", str(path), "--out", str(tmp_path / "a.html")]) == 2
    assert "cannot be read" in capsys.readouterr().err


def test_a_recording_without_rerun_is_refused_with_the_way_out(
    result, tmp_path, monkeypatch, capsys
):
    real = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "rerun" else real(name)
    )
    out = str(tmp_path / "scene.rrd")
    assert main(["view", str(tmp_path / "result.json"), "--out", out]) == 2
    assert 'pip install "cfr_jax[rerun]"' in capsys.readouterr().err


def test_a_page_that_is_there_already_stays(tmp_path, capsys):
    kept = tmp_path / "result.html"
    kept.write_text("what cfr register --view wrote")

    assert main(["view", str(tmp_path / "result.json")]) == 2
    assert "--out" in capsys.readouterr().err
    assert kept.read_text() == "what cfr register --view wrote"
