"""The table of kinds of data: all code uses it, and a kind from outside can be added."""

from __future__ import annotations

import csv
import runpy
from pathlib import Path

import batch_samples
import h5py
import numpy as np
import pytest
from oracle import pieces
from training_samples import config as training_config

from cfr_jax import io
from cfr_jax.batch import stream
from cfr_jax.cli import main
from cfr_jax.data import kinds
from cfr_jax.data.augmentation.sampling import Sampling
from cfr_jax.data.kinds.kind import DataKind, Listing, settings_of
from cfr_jax.data.layout import recognize
from cfr_jax.data.mixture import fixed_pairs, open_mixture
from cfr_jax.data.pairs import Pair
from cfr_jax.data.scenes import scene_source
from cfr_jax.evaluation.datasets import read_pairs
from cfr_jax.training.task import prepare

CONFIGS = Path(__file__).parents[2] / "configs"
NAMES = [kind.name for kind in kinds.entries()]


def scans_of(folder: Path) -> list[tuple[str, np.ndarray]]:
    """Scans of a survey, with one line per scan: its file, and where it was taken."""
    rows = [line.split() for line in (folder / "survey.log").read_text().splitlines()]
    return [(name, np.array([float(x) for x in place])) for name, *place in rows]


def pairs_of(folder: Path, step: int) -> list[Pair]:
    """Pairs of a scan and the one `step` places later, with the motion between them."""
    made = []
    scans = scans_of(folder)
    for (name, place), (other, there) in zip(scans, scans[step:], strict=False):
        truth = np.eye(4)
        truth[:3, 3] = place - there
        clouds = [io.read(folder / file).points for file in (name, other)]
        made.append(Pair(f"{name}-{other}", *clouds, transform=truth))
    return made


def train_survey(path, cache, *, step=1):
    folder = Path(path)
    pairs = pairs_of(folder, step)
    names = [pair.name for pair in pairs]
    files = sorted(folder.iterdir())
    return scene_source(
        path,
        names=names,
        frames=[tuple((str(folder), name) for name in pair.split("-")) for pair in names],
        read=lambda row: pairs[row],
        files=files,
    )


def list_survey(path: Path) -> Listing:
    names = [tuple(pair.name.split("-")) for pair in pairs_of(path, 1)]
    return Listing(names, [(path / a, path / b) for a, b in names], "stations of a survey")


SURVEY = DataKind(
    name="survey",
    words="a folder with a survey.log",
    recognize=lambda path: "a survey" if (path / "survey.log").is_file() else None,
    train=train_survey,
    evaluate=lambda path, cache, *, step: pairs_of(Path(path), step),
    example="mine.py",
    list_pairs=list_survey,
)


@pytest.fixture
def survey(monkeypatch, tmp_path):
    """A folder with four scans of one place, of a kind that is in the table for one test only.

    Without that kind, its files look like a folder of clouds.
    """
    monkeypatch.setattr(kinds, "_KINDS", list(kinds.entries()))
    kinds.add(SURVEY)
    folder = tmp_path / "survey"
    folder.mkdir()
    world = np.random.default_rng(0).normal(size=(200, 3)) * [5, 3, 1]
    lines = []
    for i in range(4):
        place = np.array([2.0 * i, -1.0 * i, 0.5])
        io.write(folder / f"{i}.ply", io.PointCloud(world - place))
        lines.append(f"{i}.ply {' '.join(map(str, place))}")
    (folder / "survey.log").write_text("\n".join(lines))
    return folder


def test_a_kind_from_outside_is_recognized_before_those_that_it_looks_like(survey):
    assert recognize(survey).kind is SURVEY and recognize(survey, "survey").found == "a survey"
    assert recognize(survey, "clouds").kind.name == "clouds"
    (survey / "survey.log").unlink()
    assert recognize(survey).kind.name == "clouds"


def test_cfr_batch_takes_the_pairs_of_a_kind_from_outside(survey, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(stream, "align_many", batch_samples.quick)
    monkeypatch.setenv("CFR_JAX_CACHE", "off")

    code = main(["batch", str(survey), "--out", str(tmp_path / "out.csv")])

    told = capsys.readouterr().out
    assert code == 0 and "a survey" in told and "3: stations of a survey" in told
    with open(tmp_path / "out.csv", newline="") as file:
        rows = [(row["source"], row["target"], row["status"]) for row in csv.DictReader(file)]
    assert rows == [(f"{i}.ply", f"{i + 1}.ply", "ok") for i in range(3)]
    assert main(["batch", "--help"]) == 0
    assert "survey      a folder with a survey.log" in capsys.readouterr().out


@pytest.mark.parametrize("named", ["survey", "auto"])
def test_a_training_draws_from_a_kind_from_outside(survey, tmp_path, named):
    given = {"here": {"kind": named, "path": str(survey), "step": 2}}

    mixture = open_mixture(given, tmp_path, "data.train")

    assert mixture.told() == "2 pairs of scans"
    whole = Sampling(points=200, neighbors=6, keep=(1.0, 1.0), noise=(0.0, 0.0))
    pair = mixture.draw(1, whole, np.random.default_rng(0))
    moved = pieces.move(pair["transform"].astype(np.float64), pair["source"])
    gap = np.linalg.norm(moved[:, None] - pair["target"], axis=-1).min(axis=1)
    assert np.quantile(gap, 0.95) < 1e-4
    wanted = "data.train.here: survey got .*steps.*wanted path and, optionally, step"
    with pytest.raises(ValueError, match=wanted):
        open_mixture({"here": {"kind": named, "path": survey, "steps": 2}}, tmp_path, "data.train")


def test_train_py_takes_a_kind_from_outside_by_its_config(survey, tmp_path):
    config = training_config(survey)
    about = {"kind": "survey", "path": str(survey)}
    config.data.train, config.data.validation = {"here": about}, {"here": about | {"step": 3}}
    with pytest.raises(ValueError, match="2 of its 2 scans are also in data.train"):
        prepare(config, tmp_path)


@pytest.mark.parametrize("named", ["survey", "auto"])
def test_an_evaluation_measures_on_a_kind_from_outside(survey, tmp_path, named):
    data = {"kind": named, "path": str(survey), "step": 1}

    pairs = read_pairs(data, 2, tmp_path)

    assert [pair.name for pair in pairs] == ["0.ply-1.ply", "1.ply-2.ply"]
    moved = pieces.move(pairs[0].transform, pairs[0].source)
    np.testing.assert_allclose(moved, pairs[0].target, atol=1e-9)
    del data["step"]
    with pytest.raises(ValueError, match=r"data lacks step, .*survey.*configs/mine\.py"):
        read_pairs(data, 2, tmp_path)


def test_a_name_can_be_used_only_once():
    for name in ("kitti", "auto"):
        with pytest.raises(ValueError, match=f"name: '{name}' is taken"):
            kinds.add(DataKind(name=name, words="", recognize=lambda _: None))
    assert [kind.name for kind in kinds.entries()] == NAMES


def test_what_is_no_kind_and_a_kind_that_recognizes_nothing_are_refused(unchecked):
    with pytest.raises(ValueError, match="^new: got 1, wanted a DataKind"):
        kinds.add(1)
    with pytest.raises(ValueError, match="^recognize: a got None, wanted a function of a path"):
        DataKind("a", "a thing", None)


@pytest.mark.parametrize(
    ("old", "new"), [("shapes", "corpus"), ("pairs", "pair-list"), ("scans", "clouds")]
)
def test_a_name_from_old_configs_is_answered_with_the_new_one(old, new, tmp_path):
    with pytest.raises(ValueError, match=f"data.train.a.kind: '{old}' has a new name: {new}"):
        open_mixture({"a": {"kind": old, "path": "a"}}, tmp_path, "data.train")
    with pytest.raises(ValueError, match=f"data.kind: '{old}' has a new name: {new}"):
        read_pairs({"kind": old, "path": "a"}, 0, tmp_path)


def test_data_that_cannot_be_trained_on_is_refused_by_name_and_by_layout(tmp_path):
    with pytest.raises(ValueError, match="kind: got 'meshes', wanted one of pair-list, pair-file"):
        open_mixture({"a": {"kind": "meshes", "path": "a"}}, tmp_path, "data.train")
    (tmp_path / "a.stl").touch()
    about = {"kind": "auto", "path": str(tmp_path)}
    with pytest.raises(ValueError, match=r"data.train.a: .*1 meshes \(.stl\), which cannot be"):
        open_mixture({"a": about}, tmp_path, "data.train")


@pytest.mark.parametrize("kind", kinds.entries(), ids=lambda kind: kind.name)
def test_the_example_of_a_kind_has_all_its_settings(kind):
    assert (kind.evaluate is None) == (not kind.example)
    if kind.evaluate is not None:
        data = runpy.run_path(str(CONFIGS / kind.example))["get_config"]().data
        needed, _ = settings_of(kind.evaluate)
        assert [name for name in needed if name not in data] == []


def test_shapes_and_scans_cannot_share_a_validation_batch(survey, tmp_path):
    with h5py.File(tmp_path / "shapes.h5", "w") as file:
        file["data"] = np.random.default_rng(0).normal(size=(2, 2048, 3)).astype(np.float32)
        file["normal"] = np.ones((2, 2048, 3), np.float32)
        file["label"] = np.zeros(2, np.int64)
    given = {
        "shapes": {"path": str(tmp_path / "shapes.h5")},
        "scans": {"kind": "survey", "path": str(survey)},
    }
    mixture = open_mixture(given, tmp_path, "data.validation")
    with pytest.raises(ValueError, match="have 60 and 717 points, wanted one size"):
        fixed_pairs(mixture, 5, Sampling(points=60, neighbors=6), 6, 0.3)
