"""`cfr merge`: a model whatever the folder holds. The poses themselves: `tests/multiway`."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from multiway_samples import views_of_a_solid

from cfr_jax import io
from cfr_jax.cli import main
from cfr_jax.geometry import motions
from cfr_jax.multiway import registering
from cfr_jax.multiway.pose_files import read_poses

SCHEMA = json.loads(
    (Path(__file__).parents[2] / "cfr_jax/cli/schemas/poses.schema.json").read_text()
)
NAMES = [f"scan{row}.ply" for row in range(4)]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder of four scans and an empty file, merged once with all outputs."""
    folder = tmp_path_factory.mktemp("merge")
    (folder / "scans").mkdir()
    clouds, poses = views_of_a_solid(4)
    for name, cloud in zip(NAMES, clouds, strict=True):
        io.write(folder / "scans" / name, io.PointCloud(cloud))
    (folder / "scans" / "empty.ply").write_bytes(b"")
    code = main(
        ["merge", str(folder / "scans"), "--out", str(folder / "model.ply")]
        + ["--poses", str(folder / "poses.json"), "--view", str(folder / "page.html")]
    )
    assert code == 0
    return folder, poses


def run(folder, *arguments, out="model.ply"):
    return main(["merge", str(folder / "scans"), "--out", str(folder / out), *arguments])


def test_everything_is_written(made):
    folder, truth = made
    # the model is of the first scan's frame, and of the surface's size
    model = io.read(folder / "model.ply")
    assert model.normals is not None
    poses = read_poses(folder / "poses.json", NAMES)
    assert list(poses) == NAMES
    for name, pose in zip(NAMES, truth, strict=True):
        wanted = motions.inverse(truth[0]) @ pose
        assert motions.angle_between(poses[name], wanted) < 1.0
    assert (folder / "page.html").read_text().count("scan2.ply") == 1
    assert len((folder / "model.pairs.jsonl").read_text().splitlines()) == 7


def test_the_document_is_as_the_schema_says(made):
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    document = json.loads((made[0] / "poses.json").read_text())
    jsonschema.Draft202012Validator(SCHEMA).validate(document)
    assert document["left_out"] == {"empty.ply": document["left_out"]["empty.ply"]}
    assert "is empty" in document["left_out"]["empty.ply"]
    assert document["models"] == [{"reference": "scan0.ply", "scans": NAMES}]


def test_a_second_run_registers_nothing_and_tells_what_is_left_out(made, monkeypatch, capsys):
    def never(*_, **__):
        raise AssertionError("registered again")

    monkeypatch.setattr(registering, "align_many", never)
    code = run(made[0], "--poses", str(made[0] / "poses.tum"), "--strict")
    out = capsys.readouterr().out
    assert code == 3
    assert "done before 6 pairs" in out and "placed      4 of 5 scans" in out
    assert "left out    empty.ply: " in out and "is empty" in out
    # the empty file came first by name
    assert np.loadtxt(made[0] / "poses.tum")[:, 0].tolist() == [1, 2, 3, 4]


def test_shards_share_the_pairs_and_the_last_run_joins_them(made, tmp_path, monkeypatch, capsys):
    # given: two machines
    (tmp_path / "scans").symlink_to(made[0] / "scans")
    for share in ("1/2", "2/2"):
        assert run(tmp_path, "--shard", share) == 0
    assert "registered  3 pairs, share 2 of 2" in capsys.readouterr().out
    # when
    monkeypatch.setattr(registering, "align_many", None)
    code = run(tmp_path)
    # then
    assert code == 0 and "placed      4 of 5 scans" in capsys.readouterr().out


def test_other_settings_are_not_mixed_into_a_journal(made, capsys):
    assert run(made[0], "--seed", "5") == 2
    assert "was started with seed 0, not 5" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--out", "model.xyz1"], "--out"),
        (["--out", "model.ply", "--poses", "poses.csv"], "--poses"),
        (["--out", "model.ply", "--view", "page.pdf"], "--view"),
        (["--out", "model.ply", "--voxel", "-1"], "--voxel"),
        (["--out", "model.ply", "--initial", "none.json"], "none.json"),
        (["--out", "scans/scan1.ply"], "would be overwritten"),
        (["--out", "model.ply", "--shard", "3/2"], "--shard"),
    ],
)
def test_what_cannot_be_used_is_told_before_anything_is_computed(
    made, arguments, told, monkeypatch, capsys
):
    monkeypatch.chdir(made[0])
    before = sorted(made[0].iterdir())
    assert main(["merge", "scans", *arguments]) == 2
    err = capsys.readouterr().err
    assert told in err and err.count("\n") <= 3
    assert sorted(made[0].iterdir()) == before


def test_too_few_scans_are_told(tmp_path, capsys):
    (tmp_path / "scans").mkdir()
    assert run(tmp_path) == 2
    assert "wanted at least two" in capsys.readouterr().err
    assert main(["merge", str(tmp_path / "none"), "--out", str(tmp_path / "m.ply")]) == 2
    assert "no file or folder" in capsys.readouterr().err
