import re

import mesh_samples as samples
import pytest

from cfr_jax.cli import main
from cfr_jax.data.corpus import read_corpus

pytest.importorskip("matplotlib", reason="contact sheets need the viz extra")


@pytest.fixture
def meshes(tmp_path):
    folder = tmp_path / "meshes"
    for seed, category in enumerate(["chair", "chair", "lamp", "lamp"]):
        path = folder / category / f"{seed}.off"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(samples.off(samples.knot(seed, scale=(1, 0.3 + 0.2 * seed, 0.3))))
    return folder


def run(*words):
    return main(["data", *map(str, words)])


def test_a_corpus_is_built_and_shown(meshes, tmp_path, capsys):
    out, sheet = tmp_path / "corpus.h5", tmp_path / "sheet.png"
    assert run("build", meshes, "--out", out, "--points", 128) == 0
    assert "all         4 shapes of 2 categories" in capsys.readouterr().out
    assert read_corpus(out).points.shape == (4, 128, 3)
    assert run("info", out, "--sheet", sheet) == 0
    told = capsys.readouterr().out
    assert "4 shapes of 128 points" in told and "     2  chair\n     2  lamp\n" in told
    assert sheet.read_bytes().startswith(b"\x89PNG")


def test_unseen_categories_go_to_the_test(meshes, tmp_path, capsys):
    assert run("build", meshes, "--out", tmp_path / "corpus", "--unseen", "chair") == 0
    assert "test        2 shapes of 1 categories" in capsys.readouterr().out
    test = read_corpus(tmp_path / "corpus/test.h5")
    assert {test.categories[label] for label in test.labels} == {"chair"}


def test_a_pattern_and_a_classification_choose_the_meshes(meshes, tmp_path, capsys):
    out = tmp_path / "corpus.h5"
    assert run("build", meshes, "--out", out, "--points", 64, "--files", "lamp/*") == 0
    assert "all         2 shapes of 1 categories" in capsys.readouterr().out
    (tmp_path / "test.cla").write_text("PSB 1\n1 3\nthing 0 3\n0 1 7\n")
    out, classes = tmp_path / "other/corpus.h5", tmp_path / "test.cla"
    out.parent.mkdir()
    assert run("build", meshes, "--out", out, "--points", 64, "--classes", classes) == 0
    told = capsys.readouterr().out
    assert "all         2 shapes of 1 categories" in told
    assert "left out    1: cannot be read" in told
    assert read_corpus(out).categories == ("thing",)


def test_all_categories_can_be_the_test(meshes, tmp_path, capsys):
    assert run("build", meshes, "--out", tmp_path / "c", "--points", 64, "--unseen", "all") == 0
    told = capsys.readouterr().out
    assert "test        4 shapes of 2 categories" in told and "to validate on" not in told
    assert sorted(path.name for path in (tmp_path / "c").iterdir()) == [
        "shape_names.txt",
        "test.h5",
    ]


def test_half_of_the_categories_are_unseen_if_none_is_named(meshes, tmp_path, capsys):
    assert run("build", meshes, "--out", tmp_path / "corpus", "--points", 64) == 0
    assert "test        2 shapes of 1 categories" in capsys.readouterr().out
    assert run("build", meshes, "--out", tmp_path / "seen", "--points", 64, "--unseen", "none") == 0
    assert "test        0 shapes of 0 categories" in capsys.readouterr().out


@pytest.mark.parametrize(
    "words, message",
    [
        (["build", "{meshes}", "--out", "{tmp}/no/such/dir"], "--out: there is no folder"),
        (["build", "{meshes}", "--out", "{tmp}/file.txt"], "--out: .* is a file"),
        (
            ["build", "{meshes}", "--out", "{tmp}/c.h5", "--unseen", "lamp"],
            "--unseen: a single file",
        ),
        (["build", "{meshes}", "--out", "{tmp}/c", "--unseen", "sofa"], "unseen: no mesh .*sofa"),
        (["build", "{meshes}", "--out", "{tmp}/c.h5", "--points", "3"], "--points: got 3"),
        (["build", "{tmp}/none", "--out", "{tmp}/c.h5"], "no folder"),
        (["build", "{meshes}", "--out", "{tmp}/c.h5", "--files", "a*"], "files: none of 4 meshes"),
        (
            ["build", "{meshes}", "--out", "{tmp}/c.h5", "--classes", "{tmp}/a.cla"],
            "classes: .*a.cla",
        ),
        (["open-cad", "--out", "{tmp}/c", "--debs", "{tmp}/none"], "--debs: there is no folder"),
        (["open-cad", "--out", "{tmp}/c", "--debs", "{tmp}"], "--debs: no 0ad-data"),
        (["open-cad", "--out", "{tmp}/c", "--compare", "{tmp}"], "--compare: no .h5 file"),
        (["info", "{tmp}/none.h5"], "no corpus at"),
        (["info", "{tmp}/none.h5", "--sheet", "{tmp}/s.jpg"], "--sheet: .* ends in .png"),
    ],
)
def test_what_cannot_be_done_is_told_in_a_line(meshes, tmp_path, capsys, words, message):
    (tmp_path / "file.txt").touch()
    assert run(*(word.format(meshes=meshes, tmp=tmp_path) for word in words)) == 2
    told = capsys.readouterr()
    assert len(told.err.splitlines()) <= 3 and not told.out
    assert re.search(message, told.err)
