"""`cfr calibrate`: weights and data in, weights with a confidence out, or how well it holds."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from cfr_jax.cli import main
from cfr_jax.evaluation.calibration import fitting
from cfr_jax.networks.probability import calibration_of, uncalibrated
from cfr_jax.weights.files import load_params, read_weights, save_params


@pytest.fixture(autouse=True)
def no_cache(monkeypatch):
    monkeypatch.setenv("CFR_JAX_CACHE", "off")


@pytest.fixture
def data(tmp_path):
    with h5py.File(tmp_path / "pairs.h5", "w") as file:
        for name in "ab":
            points = np.random.default_rng(0).normal(size=(90, 3))
            file[f"{name}/source"], file[f"{name}/target"] = points, points
            file[f"{name}/transform"] = np.eye(4)
    return tmp_path / "pairs.h5"


@pytest.fixture
def bare(tmp_path):
    """Weights that nobody calibrated, with a note."""
    save_params(tmp_path / "bare.safetensors", uncalibrated(load_params()), {"made_by": "a test"})
    return tmp_path / "bare.safetensors"


@pytest.fixture
def answers(monkeypatch):
    """Answers that need no network: more likely right the larger the first clue."""

    def gather(params, trials, count, *, told, **_):
        rng = np.random.default_rng(1)
        told(count)
        clues = {name: rng.normal(size=(count, len(used))) for name, used in fitting.USED.items()}
        right = {name: rng.normal(size=count) < 2 * held[:, 0] for name, held in clues.items()}
        return fitting.Gathered(clues, right, rng.integers(9, size=count))

    monkeypatch.setattr(fitting, "gather", gather)


def test_calibrated_weights_are_the_same_with_coefficients_beside(
    data, bare, answers, tmp_path, capsys
):
    # when
    made = tmp_path / "made.safetensors"
    code = main(["calibrate", str(bare), "--data", str(data), "--out", str(made)])

    # then
    told = capsys.readouterr().out
    before, after = read_weights(bare), read_weights(made)
    assert code == 0 and after.sha256 in told and "on shapes or pairs left out" in told
    np.testing.assert_array_equal(
        after.params["cascade"]["kernel"], before.params["cascade"]["kernel"]
    )
    fitted = calibration_of(after.params)
    for name in ("register", "align"):
        fitted.check(name, fitting.USED[name])
        assert dict(getattr(fitted, name))[fitting.USED[name][0]] > 1
    assert after.notes["made_by"] == "a test"
    assert after.notes["calibrated_on"] == "500 pairs of pairs.h5, seed 0"
    assert calibration_of(before.params) is None


def test_a_check_measures_and_writes_a_figure_alone(data, answers, tmp_path, capsys):
    figure = tmp_path / "held.png"
    before = set(tmp_path.iterdir())

    code = main(
        ["calibrate", "object", "--data", str(data), "--check", "--pairs", "80"]
        + ["--figure", str(figure)]
    )

    told = capsys.readouterr().out
    assert code == 0 and told.count("ROC area") == 2 and "of 80" in told
    assert "fitted" not in told
    assert set(tmp_path.iterdir()) - before == {figure} and figure.stat().st_size > 1000


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--check"], "has no calibration to check; give --out"),
        (["--out", "new.npz"], "--out: got new.npz, wanted a name that ends in .safetensors"),
        (["--out", "bare.safetensors"], "bare.safetensors would be overwritten"),
        ([], "one of the arguments --out --check is required"),
        (["--out", "new.safetensors", "--check"], "not allowed with argument --out"),
        (["--out", "new.safetensors", "--pairs", "0"], "--pairs: got '0', wanted an integer"),
        (["--out", "new.safetensors", "--figure", "a.pdf"], "--figure: got a.pdf"),
    ],
)
def test_what_cannot_be_done_is_told_before_anything_is_registered(
    options, said, data, bare, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}

    code = main(["calibrate", bare.name, "--data", data.name, *options])

    assert code == 2 and said in capsys.readouterr().err
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_answers_that_are_nearly_all_right_write_nothing(data, bare, answers, tmp_path, capsys):
    made = tmp_path / "made.safetensors"

    code = main(["calibrate", str(bare), "--data", str(data), "--pairs", "9", "--out", str(made)])

    assert code == 2 and "wanted at least 10 of each" in capsys.readouterr().err
    assert not made.exists()
