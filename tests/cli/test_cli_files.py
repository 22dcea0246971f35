"""Files around a command: outputs that are refused in time, transforms, the compilation cache."""

from __future__ import annotations

import json
import os
import stat
from pathlib import Path

import cli_samples
import jax
import numpy as np
import pytest

from cfr_jax import io
from cfr_jax.cli.shared import cache, outputs
from cfr_jax.cli.shared.transforms import read_transform
from cfr_jax.runtime import programs

CLOUD = io.PointCloud(np.ones((3, 3)))


def test_the_suffixes_on_offer_are_those_that_can_be_written(tmp_path):
    for suffix in outputs.cloud_suffixes():
        io.write(tmp_path / f"cloud{suffix}", CLOUD)
    for suffix in {".las", ".laz", ".obj", ".stl", ".off", ".glb", ".bin", ".pts", ".e57", ""}:
        with pytest.raises(io.CloudFileError):
            io.write(tmp_path / f"cloud{suffix}", CLOUD)


def test_checking_an_output_leaves_no_trace(tmp_path):
    outputs.check_output("--out", tmp_path / "new.ply", (".ply",))
    assert list(tmp_path.iterdir()) == []


def test_checking_an_output_keeps_what_is_there(tmp_path):
    (tmp_path / "old.PLY").write_text("kept")
    outputs.check_output("--out", tmp_path / "old.PLY", (".ply",))
    assert (tmp_path / "old.PLY").read_text() == "kept"


def test_a_folder_that_takes_no_file_is_refused(tmp_path, monkeypatch):
    # given: root may write anywhere, so the refusal is made up
    def refuse(**_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(outputs.tempfile, "TemporaryFile", refuse)

    # when, then
    with pytest.raises(ValueError, match="--out: the folder .* cannot be written to: Permission"):
        outputs.check_output("--out", tmp_path / "new.ply")


@pytest.mark.parametrize(
    "name", ["t.txt", "row.txt", "commas.csv", "t.npy", "t.json", "result.json"]
)
def test_a_transform_is_read_from_every_form(name, tmp_path):
    # given
    wanted, path = cli_samples.motion(), tmp_path / name
    match name:
        case "t.txt":
            np.savetxt(path, wanted, fmt="%.17g")
        case "row.txt":
            path.write_text(" ".join(f"{value:.17g}" for value in wanted.ravel()))
        case "commas.csv":
            np.savetxt(path, wanted, fmt="%.17g", delimiter=",")
        case "t.npy":
            np.save(path, wanted)
        case "t.json":
            path.write_text(json.dumps(wanted.tolist()))
        case "result.json":
            path.write_text(json.dumps({"fitness": 1.0, "transform": wanted.tolist()}))

    # when, then
    np.testing.assert_array_equal(read_transform(path), wanted)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("short.txt", b"1 2 3"),
        ("words.txt", b"no numbers here"),
        ("binary.txt", b"\xff\xfe\x80"),
        ("blank.txt", b" "),
        ("seventeen.txt", b"1 " * 17),
        ("underscores.txt", b"1_0 " * 16),
        ("arabic.txt", "١ ".encode() * 16),
        ("booleans.json", b"[[true, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"),
        ("texts.json", b'[["1", 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]'),
        (
            "huge.json",
            b"[" + b"[1" + b"0" * 400 + b", 0, 0, 0]," * 3 + b"[0, 0, 0, 1]]",
        ),
        ("nan.txt", b"nan " * 16),
        ("three.json", b"[[1, 0, 0], [0, 1, 0], [0, 0, 1]]"),
        ("ragged.json", b"[[1, 0], [0]]"),
        ("other.json", b'{"rotation": 1}'),
        ("null.json", b'{"transform": null}'),
        ("text.json", b'"abc"'),
        ("broken.json", b"{"),
        ("deep.json", b"[" * 100_000),
        ("broken.npy", b"\x93NUMPY"),
    ],
)
def test_a_file_without_a_transform_is_refused_by_name(name, content, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=f"{name}: wanted a 4x4 transform"):
        read_transform(tmp_path / name)


@pytest.mark.parametrize("kind", ["complex128", "bool", "U3", "V8", "M8[s]"])
def test_an_array_of_something_else_than_numbers_is_refused(kind, tmp_path):
    np.save(tmp_path / "t.npy", np.zeros((4, 4), kind))
    with pytest.raises(ValueError, match="t.npy: .* wanted floats or integers"):
        read_transform(tmp_path / "t.npy")


def test_a_pickled_array_is_not_unpickled(tmp_path):
    np.save(tmp_path / "object.npy", np.array([{"a": 1}], object), allow_pickle=True)
    with pytest.raises(ValueError, match="object.npy"):
        read_transform(tmp_path / "object.npy")


@pytest.fixture
def jax_cache(monkeypatch):
    """JAX as it starts, without a cache; all settings are put back."""
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: jax.config.values[name] for name in names}
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.delenv("CFR_JAX_CACHE", raising=False)
    monkeypatch.setattr(programs, "_places", [])
    yield lambda: jax.config.values["jax_compilation_cache_dir"]
    for name, value in before.items():
        jax.config.update(name, value)


def test_compiled_programs_are_kept_in_the_users_cache_folder(jax_cache, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    cache.keep_compiled_programs()
    assert Path(jax_cache()) == tmp_path / "xdg" / "cfr_jax"
    assert stat.S_ISDIR((tmp_path / "xdg" / "cfr_jax").stat().st_mode)


def test_without_xdg_the_cache_is_in_the_home_folder(jax_cache, tmp_path, monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    cache.keep_compiled_programs()
    assert Path(jax_cache()) == tmp_path / ".cache" / "cfr_jax"


def test_the_cache_can_be_placed_and_turned_off(jax_cache, tmp_path, monkeypatch):
    monkeypatch.setenv("CFR_JAX_CACHE", "off")
    cache.keep_compiled_programs()
    assert jax_cache() is None

    monkeypatch.setenv("CFR_JAX_CACHE", str(tmp_path / "here"))
    cache.keep_compiled_programs()
    assert jax_cache() == str(tmp_path / "here")


def test_a_cache_that_jax_was_told_of_stays(jax_cache, tmp_path, monkeypatch):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "theirs"))
    monkeypatch.setenv("CFR_JAX_CACHE", str(tmp_path / "ours"))
    cache.keep_compiled_programs()
    assert jax_cache() == str(tmp_path / "theirs")


@pytest.mark.parametrize("obstacle", ["a file in the way", "a folder nobody may write"])
def test_a_cache_that_cannot_be_kept_is_done_without(obstacle, jax_cache, tmp_path, monkeypatch):
    # given
    monkeypatch.setenv("CFR_JAX_CACHE", str(tmp_path / "place"))
    if obstacle == "a file in the way":
        (tmp_path / "place").write_text("")
    else:
        monkeypatch.setattr(cache.os, "access", lambda *_: False)

    # when
    cache.keep_compiled_programs()

    # then
    assert jax_cache() is None


def test_a_cache_is_made_for_its_owner_alone(jax_cache, tmp_path, monkeypatch):
    monkeypatch.setenv("CFR_JAX_CACHE", str(tmp_path / "deep" / "place"))
    before = os.umask(0)
    try:
        cache.keep_compiled_programs()
    finally:
        os.umask(before)
    made = [tmp_path / "deep" / "place", *(tmp_path / "deep" / "place").iterdir()]
    assert len(made) == 2
    assert {stat.S_IMODE(folder.stat().st_mode) for folder in made} == {0o700}


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o720, 0o702, 0o1777])
def test_a_cache_that_others_may_write_is_refused_in_words(
    mode, jax_cache, tmp_path, monkeypatch, capsys
):
    # given
    place = tmp_path / "place"
    place.mkdir()
    place.chmod(mode)
    monkeypatch.setenv("CFR_JAX_CACHE", str(place))

    # when
    cache.keep_compiled_programs()

    # then
    assert jax_cache() is None and programs._places == []
    assert "may be written by other users" in capsys.readouterr().err
    with pytest.raises(ValueError, match="may be written by other users"):
        programs.keep_in(place)


def test_a_cache_of_another_user_is_refused_in_words(jax_cache, tmp_path, monkeypatch, capsys):
    # given
    monkeypatch.setenv("CFR_JAX_CACHE", str(tmp_path))
    tmp_path.chmod(0o755)
    monkeypatch.setattr(os, "geteuid", lambda: tmp_path.stat().st_uid + 1)
    if tmp_path.stat().st_uid == 0:  # folders of root are trusted
        os.chown(tmp_path, 4321, -1)
        monkeypatch.setattr(os, "geteuid", lambda: 0)

    # when
    cache.keep_compiled_programs()

    # then
    assert jax_cache() is None
    assert "belongs to another user" in capsys.readouterr().err


def test_a_folder_of_programs_that_others_may_write_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(programs, "_places", [])
    programs.keep_in(tmp_path / "cache")
    programs._places[0].chmod(0o777)
    with pytest.raises(ValueError, match="programs-.* may be written by other users"):
        programs.keep_in(tmp_path / "cache")
