"""`cfr models`, `cfr reproduce` and `cfr completion`."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import cli_samples
import jax
import jsonschema
import numpy as np
import pytest

from cfr_jax.batch.stream import Outcome
from cfr_jax.cli import main, make_parser, models
from cfr_jax.evaluation import reproduction
from cfr_jax.io import PointCloud
from cfr_jax.weights import cards
from cfr_jax.weights.files import read_weights, shipped

CLI = Path(cards.__file__).parents[1] / "cli" / "schemas"
CARD = cards.read_card("object")


def schema(name):
    held = json.loads((CLI / f"{name}.schema.json").read_text("utf-8"))
    jsonschema.Draft202012Validator.check_schema(held)
    return jsonschema.Draft202012Validator(held)


def test_all_weights_of_ours_that_ship_have_a_card_that_is_theirs():
    # those of other networks are there to be compared with, and nobody registers by them
    ours = [name for name in shipped() if read_weights(name).network == "cfr"]
    assert list(cards.names()) == ours
    for name in cards.names():
        weights, card = read_weights(name), cards.read_card(name)
        assert card["sha256"] == weights.sha256
        assert card["parameters"] == sum(map(np.size, jax.tree.leaves(weights.params)))


def test_cards_are_listed_for_people_and_for_scripts(capsys):
    assert main(["models"]) == 0
    text = capsys.readouterr().out
    for said in ("object:", CARD["sha256"], "880,906", "CC-BY-SA-3.0", "median"):
        assert said in text

    assert main(["models", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    schema("models").validate(document)
    assert [card["name"] for card in document["models"]] == list(cards.names())


def test_scores_are_told_in_the_unit_they_were_measured_in():
    scores = {"err_r_mean": 1.5, "err_r_median": 0.5, "recall_1deg_0.02": 0.25, "recall_5deg_2m": 1}
    assert models.scores_in_words(scores) == (
        "rotation 1.50° mean, 0.50° median; 25% within 1° and 0.02, 100% within 5° and 2 m"
    )


def test_models_are_listed_without_jax():
    code = (
        "import sys; from cfr_jax.cli import main; main(['models']); sys.exit('jax' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0


def test_a_card_of_other_weights_is_refused(tmp_path, monkeypatch):
    # given
    for suffix in (".json", ".safetensors"):
        shutil.copy(cards.FOLDER / f"object{suffix}", tmp_path)
    card = (tmp_path / "object.json").read_text("utf-8")
    (tmp_path / "object.json").write_text(card.replace(CARD["sha256"], "0" * 64), "utf-8")
    monkeypatch.setattr(cards, "FOLDER", tmp_path)

    # when, then
    with pytest.raises(ValueError, match="to other weights.*\n.*model_card.py object"):
        cards.read_card("object")


def test_damaged_files_are_named_whatever_bit_flipped(tmp_path, monkeypatch):
    for suffix in (".json", ".safetensors"):
        shutil.copy(cards.FOLDER / f"object{suffix}", tmp_path)
    monkeypatch.setattr(cards, "FOLDER", tmp_path)
    rng = np.random.default_rng(0)
    for suffix in (".json", ".safetensors"):
        path = tmp_path / f"object{suffix}"
        content = path.read_bytes()
        refused, header = 0, min(len(content), 8 + int.from_bytes(content[:8], "little"))
        places = [*range(8), *rng.integers(header, size=200).tolist()]
        for at in places:
            flipped = bytes([content[at] ^ 1 << int(rng.integers(8))])
            path.write_bytes(content[:at] + flipped + content[at + 1 :])
            try:
                cards.read_card("object")  # a changed word of prose is still a card
            except ValueError as error:
                assert "object" in str(error)
                refused += 1
        assert refused > 50
        path.write_bytes(content[: header // 2])
        with pytest.raises(ValueError, match=f"object{suffix} is damaged"):
            cards.read_card("object")
        path.write_bytes(content)
    cards.read_card("object")


def test_the_pairs_are_the_same_every_time_and_all_differ():
    first, again = reproduction.make_pairs(26), reproduction.make_pairs(26)
    for one, other in zip(first, again, strict=True):
        assert np.array_equal(one.source, other.source)
        assert np.array_equal(one.transform, other.transform)
    assert first[0].name == first[24].name
    assert not np.array_equal(first[0].transform, first[24].transform)
    assert first[0].source.shape == (717, 3)


def test_the_shapes_are_whole_and_of_unseen_categories():
    from cfr_jax.data.making.open_cad import UNSEEN

    shapes = reproduction.read_shapes()
    assert shapes.points.shape == (24, 2048, 3) and set(shapes.categories) <= set(UNSEEN)
    radius = np.linalg.norm(shapes.points, axis=-1).max(axis=1)
    np.testing.assert_allclose(radius, 1, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(shapes.normals, axis=-1), 1, atol=1e-5)
    credits = (cards.FOLDER / "held_out.md").read_text("utf-8")
    assert all(f"`{name}`" in credits for name in shapes.names) and "CC0" in credits
    assert reproduction.SHAPES.stat().st_size < 1e6


def test_a_score_holds_within_its_tolerance_and_when_it_is_better():
    expected, tolerance = CARD["reproduce"]["expected"], CARD["reproduce"]["tolerance"]
    assert reproduction.missed(expected, expected, tolerance) == []
    for name, worse, better in (("err_r_median", 1.0, -1.0), ("recall_5deg_0.1", -0.2, 0.2)):
        for change, count in ((worse, 1), (better, 0)):
            refined = expected["refined"] | {name: expected["refined"][name] + change}
            changed = expected | {"refined": refined}
            assert len(reproduction.missed(changed, expected, tolerance)) == count
    refined = expected["refined"] | {"err_r_mean": float("nan")}
    assert reproduction.missed(expected | {"refined": refined}, expected, tolerance)


@pytest.mark.parametrize(("worse", "code"), [(0.0, 0), (5.0, 3)])
def test_reproduce_says_whether_the_published_score_holds(
    worse, code, tmp_path, monkeypatch, capsys
):
    # given
    expected = CARD["reproduce"]["expected"]
    measured = {stage: scores | {"err_r_mean": scores["err_r_mean"] + worse}
                for stage, scores in expected.items()}  # fmt: skip
    monkeypatch.setattr(reproduction, "measure", lambda params, told: measured)
    monkeypatch.setenv("CFR_JAX_CACHE", "off")

    # when
    found = main(["reproduce", "object", "--json", str(tmp_path / "r.json")])

    # then
    document = json.loads((tmp_path / "r.json").read_text())
    schema("reproduce").validate(document)
    assert found == code and document["holds"] == (code == 0)
    verdict = "the published score holds" if code == 0 else "the published score does not hold"
    assert capsys.readouterr().out.strip().endswith(verdict)


def test_reproduce_writes_its_scores_alone_to_stdout_if_asked_to(monkeypatch, capsys, tmp_path):
    expected = CARD["reproduce"]["expected"]
    monkeypatch.setattr(reproduction, "measure", lambda params, told: expected)
    monkeypatch.setenv("CFR_JAX_CACHE", "off")
    monkeypatch.chdir(tmp_path)

    assert main(["reproduce", "object", "--json", "-"]) == 0

    told = capsys.readouterr()
    schema("reproduce").validate(json.loads(told.out))
    assert told.err.strip().endswith("the published score holds")
    assert not list(tmp_path.iterdir())


def test_scores_are_measured_against_the_truth(monkeypatch):
    # given answers that are right, but for one pair that has none
    cloud = PointCloud(np.eye(3))

    def answer(clouds, **_):
        for index, _pair in enumerate(clouds):
            truth = np.array(pairs[index].transform, np.float64)
            found = cli_samples.alignment(cloud, cloud, transform=truth, transforms=np.eye(4)[None])
            yield Outcome(index, None if index == 3 else found, "broken" if index == 3 else None)

    pairs = reproduction.make_pairs(4)
    monkeypatch.setattr(reproduction, "align_many", answer)

    # when
    scores = reproduction.measure({}, count=4)

    # then
    assert scores["refined"]["err_r_mean"] == pytest.approx(45, abs=0.1)
    assert scores["refined"]["recall_1deg_0.02"] == 0.75 == scores["refined"]["recall_5deg_0.1"]
    assert scores["network"]["recall_5deg_0.1"] == 0.0


@pytest.mark.slow
def test_the_published_score_holds_here():
    assert main(["reproduce", "object"]) == 0


def complete(script: str, *words: str) -> list[str]:
    """What bash would offer for a line of these words."""
    line = " ".join(f"'{word}'" for word in words)
    code = f"{script}\nCOMP_WORDS=({line}); COMP_CWORD={len(words) - 1}; _shtab_cfr\n"
    code += 'printf "%s\\n" "${COMPREPLY[@]}"'
    child = subprocess.run(["bash", "-c", code], capture_output=True, text=True)
    assert child.returncode == 0, child.stderr
    return child.stdout.split()


def test_bash_completes_commands_options_and_files(capsys, tmp_path, monkeypatch):
    pytest.importorskip("shtab", reason='needs shtab: pip install "cfr_jax[completion]"')
    assert main(["completion", "bash"]) == 0
    script = capsys.readouterr().out

    assert complete(script, "cfr", "reg") == ["register"]
    assert {"--out", "--shard"} <= set(complete(script, "cfr", "batch", "--"))
    (tmp_path / "scan_one.ply").touch()
    monkeypatch.chdir(tmp_path)
    assert complete(script, "cfr", "register", "scan_") == ["scan_one.ply"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_every_shell_gets_all_commands(shell, capsys):
    pytest.importorskip("shtab", reason='needs shtab: pip install "cfr_jax[completion]"')
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    [commands] = [a.choices for a in make_parser()._actions if hasattr(a, "choices") and a.choices]
    assert all(command in script for command in commands)
