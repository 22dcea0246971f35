"""`cfr convert`: a checkpoint in, weights out, and where they came from."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from oracle.authors import random_rpmnet_state_dict, random_state_dict

from cfr_jax import align
from cfr_jax.cli import main
from cfr_jax.geometry import motions
from cfr_jax.weights.conversion import from_state_dict
from cfr_jax.weights.files import SHIPPED, read_weights


@pytest.fixture
def checkpoint(tmp_path):
    path = tmp_path / "authors.npz"
    np.savez(path, **random_state_dict(0))
    return path


def test_converted_weights_can_be_loaded_and_say_what_they_were_made_from(
    checkpoint, tmp_path, capsys
):
    # when
    code = main(["convert", str(checkpoint), "--out", str(tmp_path / "ours.safetensors")])

    # then
    weights = read_weights(tmp_path / "ours.safetensors")
    wanted = from_state_dict(random_state_dict(0))
    assert code == 0 and weights.sha256 in capsys.readouterr().out
    np.testing.assert_array_equal(weights.params["cascade"]["kernel"], wanted["cascade"]["kernel"])
    assert weights.notes["converted_from"] == "authors.npz"
    digest = hashlib.sha256(checkpoint.read_bytes()).hexdigest()
    assert weights.notes["converted_from_sha256"] == digest


def test_rpmnet_is_recognized_and_refused_where_our_network_is_wanted(tmp_path, capsys):
    # given
    np.savez(tmp_path / "theirs.npz", **random_rpmnet_state_dict(0))
    path = tmp_path / "ours.safetensors"

    # when
    code = main(["convert", str(tmp_path / "theirs.npz"), "--out", str(path)])

    # then
    assert code == 0 and "RPM-Net" in capsys.readouterr().out
    assert read_weights(path).network == "rpmnet"
    clouds = (
        str(SHIPPED.parents[1] / "cli" / "demo_pair" / f"{side}.ply")
        for side in ("source", "target")
    )
    assert main(["register", *clouds, "--weights", str(path)]) == 2
    assert "holds the network RPM-Net, wanted CFR" in capsys.readouterr().err


def test_float16_halves_a_file_and_moves_answers_little(tmp_path):
    # given the shipped weights, and the demo pair
    half = tmp_path / "half.safetensors"
    demo = SHIPPED.parents[1] / "cli" / "demo_pair"

    # when
    code = main(["convert", str(SHIPPED / "object.safetensors"), "--out", str(half), "--float16"])

    # then the file keeps its notes and its calibration
    assert code == 0
    assert half.stat().st_size < 0.55 * (SHIPPED / "object.safetensors").stat().st_size
    rounded, whole = read_weights(half), read_weights("object")
    assert rounded.notes == {**whole.notes, "stored_again_from_sha256": whole.sha256}
    assert rounded.params["calibration"] == whole.params["calibration"]
    # and the motion that the network finds moves by less than 0.01 degrees and 0.01 of the size
    ours, theirs = (
        align(demo / "source.ply", demo / "target.ply", params=weights.params, refine=False)
        for weights in (rounded, whole)
    )
    assert motions.angle_between(ours.transform, theirs.transform) < 0.01
    assert np.linalg.norm(ours.transform[:3, 3] - theirs.transform[:3, 3]) < 0.01


@pytest.mark.parametrize(
    ("source", "target"),
    [
        ("missing.pth", "ours.safetensors"),
        ("authors.npz", "ours.npz"),
        ("authors.npz", "nowhere/ours.safetensors"),
        ("damaged.npz", "ours.safetensors"),
    ],
)
def test_what_cannot_be_converted_is_told_and_nothing_is_written(
    source, target, checkpoint, tmp_path, monkeypatch, capsys
):
    # given
    monkeypatch.chdir(tmp_path)
    (tmp_path / "damaged.npz").write_bytes(checkpoint.read_bytes()[:1000])

    # when
    code = main(["convert", source, "--out", target])

    # then
    err = capsys.readouterr().err
    assert code == 2 and err.startswith("cfr convert: error: ") and err.count("\n") <= 3
    assert not (tmp_path / target).exists()
