"""`cfr register`: what it hands to `align`, what it writes, when it refuses."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import cli_samples
import jsonschema
import numpy as np
import pytest

import cfr_jax
from cfr_jax import io
from cfr_jax.cli import main
from cfr_jax.cli.shared import report
from cfr_jax.weights import files
from cfr_jax.weights.files import Weights

SCHEMA = json.loads(
    (Path(cfr_jax.__file__).parent / "cli" / "schemas" / "register.schema.json").read_text("utf-8")
)


@pytest.fixture
def pair(tmp_path):
    return cli_samples.write_pair(tmp_path)


@pytest.fixture
def answering(monkeypatch):
    """`align` answers at once, with what is asked for; what it was called with comes back."""
    calls: list[dict] = []

    def set_up(**changes):
        def align(source, target, **options):
            calls.append({"source": source, "target": target, **options})
            return cli_samples.alignment(source, target, **changes)

        monkeypatch.setattr(report, "align", align)
        monkeypatch.setattr(
            files,
            "read_weights",
            lambda name, network: Weights({}, f"<{name}>", network, "0" * 64, {}),
        )
        return calls

    return set_up


def test_options_reach_align(pair, tmp_path, answering):
    # given
    calls = answering()
    np.savetxt(tmp_path / "initial.txt", cli_samples.motion(5.0))
    options = ["--no-refine", "--max-points", "99", "--seed", "7", "--weights", "mine"]

    # when
    code = main(["register", *pair, *options, "--initial", str(tmp_path / "initial.txt")])

    # then
    [call] = calls
    assert code == 0
    assert (call["refine"], call["max_points"], call["seed"]) == (False, 99, 7)
    np.testing.assert_array_equal(call["initial"], cli_samples.motion(5.0))
    np.testing.assert_allclose(call["source"].points, cli_samples.points(700, 0))


def test_defaults_are_those_of_align(pair, answering):
    calls = answering()
    assert main(["register", *pair]) == 0
    assert {key: calls[0][key] for key in ("refine", "initial", "max_points", "seed")} == {
        "refine": True,
        "initial": None,
        "max_points": None,
        "seed": 0,
    }


@pytest.mark.parametrize(("text", "scale"), [("auto", "auto"), ("0.001", 0.001)])
def test_the_scale_reaches_align(pair, answering, text, scale):
    calls = answering()

    assert main(["register", *pair, "--scale", text]) == 0

    assert calls[0]["scale"] == scale


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "mm", ""])
def test_a_scale_that_is_none_is_refused(pair, text, capsys):
    code = main(["register", *pair, "--scale", text])

    told = capsys.readouterr().err
    assert code == 2 and "--scale" in told and "above 0, or auto" in told


def test_a_scaled_answer_is_written_with_its_scale(pair, tmp_path, answering, capsys):
    # given an answer with a factor, and a source with normals
    answering(scale=0.001, scale_confidence=0.75)
    points = cli_samples.points(700, 0)
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    io.write(tmp_path / "normals.ply", io.PointCloud(points, normals))

    # when
    out, told = tmp_path / "moved.ply", tmp_path / "told.json"
    arguments = [str(tmp_path / "normals.ply"), pair[1], "--out", str(out), "--json", str(told)]
    assert main(["register", *arguments, "--view", str(tmp_path / "page.html")]) == 0

    # then the points are scaled and moved, and the normals are turned alone
    moved, motion = io.read(out), cli_samples.motion()
    wanted = 0.001 * points @ motion[:3, :3].T + motion[:3, 3]
    np.testing.assert_allclose(moved.points, wanted, atol=1e-6)
    np.testing.assert_allclose(moved.normals, normals @ motion[:3, :3].T, atol=1e-5)
    document = json.loads(told.read_text())
    jsonschema.validate(document, SCHEMA)
    assert (document["scale"], document["scale_confidence"]) == (0.001, 0.75)
    np.testing.assert_array_equal(document["transform"], motion)
    np.testing.assert_allclose(document["similarity"], motion @ np.diag([1e-3, 1e-3, 1e-3, 1]))
    printed = capsys.readouterr().out
    assert "scale       0.001, millimeters to meters, estimated, confidence 0.75" in printed
    assert "scaled source onto target" in printed


def test_the_printed_transform_is_the_answer(pair, answering, capsys):
    # given
    answering()

    # when
    main(["register", *pair])

    # then
    out = capsys.readouterr().out
    lines = out.splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("transform"))
    printed = np.array([line.split() for line in lines[start + 1 : start + 5]], float)
    np.testing.assert_allclose(printed, cli_samples.motion(), atol=1e-11)
    assert "20.000°" in out and "trusted" in out and "not trusted" not in out
    assert "0.250 s, and 2.0 s to compile" in out


def test_map_coordinates_are_printed_to_the_millimeter(pair, answering, capsys):
    far = cli_samples.motion(translation=(5_123_456.7891, 0.0, -4_999_999.1234))
    answering(transform=far)
    main(["register", *pair])
    out = capsys.readouterr().out
    assert "5123456.7891" in out and "-4999999.1234" in out


def test_json_on_standard_output_stands_alone_and_fits_its_schema(pair, answering, capsys):
    # given
    answering(warnings=("small clouds",))

    # when
    code = main(["register", *pair, "--json", "-"])

    # then
    out, err = capsys.readouterr()
    document = json.loads(out)
    jsonschema.validate(document, SCHEMA)
    assert code == 0 and err == "cfr register: warning: small clouds\n"
    np.testing.assert_array_equal(document["transform"], cli_samples.motion())
    assert len(document["transforms"]) == 2
    assert document["source"] == {
        "name": "source.ply",
        "path": pair[0],
        "points": 700,
        "used": 350,
    }
    assert document["target"]["used"] == document["target"]["points"] == 720
    assert (document["fitness"], document["inlier_rmse"]) == (0.75, 0.0125)
    assert (document["confidence"], document["trusted"]) == (0.875, True)
    assert document["seconds"] == {"compile": 2.0, "run": 0.25, "total": 2.5}
    assert document["weights"] == {"name": "<object>", "sha256": "0" * 64}
    assert document["version"] == cfr_jax.__version__


def test_without_calibration_the_confidence_is_null_and_strictly_not_trusted(
    pair, answering, capsys
):
    answering(confidence=None, warnings=("not to be trusted: no calibration",))

    code = main(["register", *pair, "--json", "-", "--strict"])

    document = json.loads(capsys.readouterr().out)
    jsonschema.validate(document, SCHEMA)
    assert code == 3 and document["confidence"] is None and document["trusted"] is False
    main(["register", *pair])
    out = capsys.readouterr().out
    assert "confidence  unknown" in out and "verdict     not trusted" in out


def test_the_schema_is_sound_and_closed(pair, answering, capsys):
    # given
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    answering()
    main(["register", *pair, "--json", "-"])
    document = json.loads(capsys.readouterr().out)
    assert set(document) == set(SCHEMA["required"]) == set(SCHEMA["properties"])

    # when, then: whatever is left out or made up is noticed
    for changed in (
        document | {"unknown": 1},
        {key: value for key, value in document.items() if key != "fitness"},
        document | {"transform": document["transform"][:3]},
        document | {"confidence": 1.5},
    ):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(changed, SCHEMA)


def test_an_earlier_answer_is_a_start(pair, tmp_path, answering):
    # given
    calls = answering()
    main(["register", *pair, "--json", str(tmp_path / "first.json")])

    # when
    code = main(["register", *pair, "--initial", str(tmp_path / "first.json")])

    # then
    assert code == 0
    np.testing.assert_array_equal(calls[1]["initial"], cli_samples.motion())


def test_the_written_source_lies_on_the_target(pair, tmp_path, answering):
    # given, with normals, which turn along
    answering()
    source = cli_samples.points(700, 0)
    normals = np.random.default_rng(2).normal(size=source.shape)
    io.write(tmp_path / "with_normals.ply", io.PointCloud(source, normals))

    # when
    arguments = [str(tmp_path / "with_normals.ply"), pair[1], "--out", str(tmp_path / "out.npz")]
    code = main(["register", *arguments])

    # then
    moved, rotation = io.read(tmp_path / "out.npz"), cli_samples.motion()[:3, :3]
    assert code == 0
    np.testing.assert_allclose(moved.points, source @ rotation.T + [0.3, -0.1, 0.2], atol=1e-12)
    turned = normals / np.linalg.norm(normals, axis=1, keepdims=True) @ rotation.T
    np.testing.assert_allclose(moved.normals, turned, atol=1e-12)


@pytest.mark.parametrize("times", [1, 2])
def test_each_initial_transform_is_a_start(pair, tmp_path, answering, times):
    calls = answering()
    np.savetxt(tmp_path / "initial.txt", cli_samples.motion(5.0))

    code = main(["register", *pair, *["--initial", str(tmp_path / "initial.txt")] * times])

    assert code == 0
    assert calls[0]["initial"].shape == ((4, 4) if times == 1 else (2, 4, 4))


def test_a_global_search_tells_its_start_and_the_other_answers(pair, answering, capsys):
    calls = answering(initial=cli_samples.motion(90.0), starts=128, alternatives=np.eye(4)[None])

    code = main(["register", *pair, "--global", "--json", "-"])

    document = json.loads(capsys.readouterr().out)
    jsonschema.validate(document, SCHEMA)
    assert code == 0 and calls[0]["initial"] == "global"
    assert (document["starts"], document["alternatives"]) == (128, [np.eye(4).tolist()])
    np.testing.assert_array_equal(document["initial"], cli_samples.motion(90.0))


def test_a_search_may_wait_for_an_answer_in_doubt(pair, answering):
    calls = answering()

    code = main(["register", *pair, "--auto"])

    assert code == 0 and calls[0]["initial"] == "auto"


@pytest.mark.parametrize("searching", ["--global", "--auto"])
def test_a_start_and_a_search_are_not_asked_for_together(pair, capsys, searching):
    code = main(["register", *pair, searching, "--initial", "a.txt"])

    assert code == 2
    assert "not allowed with argument" in capsys.readouterr().err


def test_pictures_show_the_way_from_the_file_over_the_start_to_the_answer(pair, answering):
    # given
    initial = cli_samples.motion(5.0)
    answering(initial=initial)
    source, target = (io.read(path) for path in pair)

    # when
    scene = report.as_scene(report.register(source, target, initial=initial), {"error": "2 m"})

    # then
    assert scene.labels == ("as given", "start", "iteration 1", "iteration 2", "refined")
    np.testing.assert_array_equal(scene.transforms[0], np.eye(4))
    np.testing.assert_array_equal(scene.transforms[1], initial)
    np.testing.assert_array_equal(scene.transforms[-1], cli_samples.motion())
    assert np.isnan(scene.weights[1::2]).all() and scene.weights[-2] == 1.0
    assert next(iter(scene.facts)) == "error" and "confidence" in scene.facts


def test_all_outputs_are_written_and_named(pair, tmp_path, answering, capsys):
    # given
    answering(refined=False)
    files = {
        "--out": "moved.pcd",
        "--json": "result.json",
        "--view": "page.html",
    }
    options = [text for option, name in files.items() for text in (option, str(tmp_path / name))]
    options += ["--view", str(tmp_path / "picture.png")]

    # when
    code = main(["register", *pair, *options])

    # then
    out = capsys.readouterr().out
    assert code == 0
    for name in (*files.values(), "picture.png"):
        assert (tmp_path / name).stat().st_size > 500
        assert f"wrote       {tmp_path / name}" in out
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")
    assert b"source.ply" in (tmp_path / "page.html").read_bytes()
    assert len(list(tmp_path.iterdir())) == 3 + len(files)


@pytest.mark.parametrize("strict", [True, False])
@pytest.mark.parametrize("changes", [{}, {"confidence": 0.1}, {"determined": False}])
def test_only_strict_makes_a_doubtful_answer_a_failure(changes, strict, pair, answering, capsys):
    answering(**changes)
    code = main(["register", *pair, *(["--strict"] if strict else [])])
    assert code == (3 if strict and changes else 0)
    assert ("not trusted" in capsys.readouterr().out) == bool(changes)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--out", "moved.las"], "--out"),
        (["--out", "nowhere/moved.ply"], "there is no folder nowhere"),
        (["--out", "folder.ply"], "folder.ply is a folder"),
        (["--out", "source.ply"], "source.ply would be overwritten"),
        (["--out", "./link.ply"], "link.ply would be overwritten"),
        (["--json", "x.ply", "--out", "x.ply"], "x.ply would be overwritten"),
        (["--view", "page.pdf"], "--view"),
        (["--view", "page.html", "--view", "./page.html"], "page.html would be overwritten"),
        (["--json", "/dev/null"], "not a regular file"),
        (["--initial", "missing.npy"], "missing.npy: cannot be read"),
        (["--weights", "nosuch"], "nosuch"),
    ],
)
def test_what_cannot_be_used_is_refused_before_anything_is_computed(
    options, complaint, pair, tmp_path, monkeypatch, capsys
):
    # given
    def align(*_, **__):
        raise AssertionError("computed")

    monkeypatch.setattr(report, "align", align)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.ply").mkdir()
    (tmp_path / "link.ply").symlink_to("source.ply")
    before = sorted(tmp_path.iterdir())

    # when
    code = main(["register", *pair, *options])

    # then
    out, err = capsys.readouterr()
    assert code == 2 and out == "" and complaint in err and err.count("\n") <= 3
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("option", ["--view", "--png"])  # the second is the former name
def test_a_picture_without_matplotlib_is_refused_with_the_way_out(
    option, pair, monkeypatch, capsys
):
    monkeypatch.setattr("cfr_jax.cli.shared.outputs.can_draw", lambda: False)
    assert main(["register", *pair, option, "picture.png"]) == 2
    assert 'pip install "cfr_jax[viz]"' in capsys.readouterr().err


@pytest.mark.parametrize("broken", ["source", "target"])
def test_a_damaged_cloud_is_named_in_the_complaint(broken, pair, tmp_path, capsys):
    # given
    path = {"source": pair[0], "target": pair[1]}[broken]
    Path(path).write_bytes(b"\x00\xff no cloud \x80\n" * 5)

    # when
    code = main(["register", *pair, "--json", "-"])

    # then
    out, err = capsys.readouterr()
    assert code == 2 and out == "" and path in err and err.count("\n") <= 3


def test_the_real_thing_finds_a_known_motion_twice_alike(pair, tmp_path, capsys):
    # given
    arguments = ["register", *pair, "--out", str(tmp_path / "moved.npy"), "--json"]

    # when
    codes = [main([*arguments, str(tmp_path / name)]) for name in ("first.json", "second.json")]

    # then
    first, second = (
        json.loads((tmp_path / name).read_text()) for name in ("first.json", "second.json")
    )
    jsonschema.validate(first, SCHEMA)
    assert codes == [0, 0]
    assert {**first, "seconds": None} == {**second, "seconds": None}
    truth, found = cli_samples.motion(), np.array(first["transform"])
    np.testing.assert_allclose(found, truth, atol=0.03)
    assert first["trusted"] and first["refined"] and len(first["transforms"]) == 10
    moved = cli_samples.points(700, 0) @ found[:3, :3].T + found[:3, 3]
    np.testing.assert_allclose(np.load(tmp_path / "moved.npy"), moved, atol=1e-12)
    assert capsys.readouterr().err == ""


def test_in_a_process_of_its_own_it_keeps_what_it_compiled_and_says_nothing_else(pair, tmp_path):
    # given
    environment = {**os.environ, "CFR_JAX_CACHE": str(tmp_path / "cache")}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    command = [sys.executable, "-m", "cfr_jax", "register", *pair, "--json", "-"]

    # when
    runs = [
        subprocess.run(command, capture_output=True, text=True, env=environment) for _ in range(2)
    ]

    # then
    assert [run.returncode for run in runs] == [0, 0]
    first, second = (json.loads(run.stdout) for run in runs)
    assert first["transform"] == second["transform"]
    assert any((tmp_path / "cache").iterdir())
    assert second["seconds"]["compile"] < first["seconds"]["compile"]
    assert all(line.startswith("cfr register: warning") for line in runs[1].stderr.splitlines())


@pytest.mark.parametrize(("options", "wanted"), [((), True), (("--thinned",), False)])
def test_all_points_are_used_unless_told_otherwise(pair, answering, options, wanted):
    calls = answering()

    assert main(["register", *pair, *options]) == 0

    assert calls[0]["all_points"] is wanted


def test_the_old_option_is_refused_and_the_new_one_named(pair, answering, capsys):
    answering()

    assert main(["register", *pair, "--all-points"]) == 2

    assert "--all-points: all points are used without it; --thinned" in capsys.readouterr().err
