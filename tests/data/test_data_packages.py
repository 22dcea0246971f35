import subprocess

import mesh_samples as samples
import pytest

from cfr_jax.data.making import packages
from cfr_jax.data.making.packages import download, extract, find_deb

FILES = {"usr/share/a.txt": b"one", "usr/share/deep/b.bin": b"\0" * 5000, "usr/other": b"x"}


@pytest.mark.parametrize("packed", ["xz", "gz", "bz2"])
def test_wanted_files_are_extracted(tmp_path, packed):
    samples.deb(tmp_path / "p_1_all.deb", FILES, packed)
    paths = extract(tmp_path / "p_1_all.deb", lambda name: "share" in name, tmp_path / "out")
    assert [path.relative_to(tmp_path / "out").as_posix() for path in paths] == list(FILES)[:2]
    assert [path.read_bytes() for path in paths] == list(FILES.values())[:2]
    assert not (tmp_path / "out/usr/other").exists()


def test_files_that_are_already_there_are_kept(tmp_path):
    samples.deb(tmp_path / "p_1_all.deb", FILES)
    (first,) = extract(tmp_path / "p_1_all.deb", lambda name: name.endswith("a.txt"), tmp_path)
    before = first.stat().st_mtime_ns
    extract(tmp_path / "p_1_all.deb", lambda name: name.endswith("a.txt"), tmp_path)
    assert first.stat().st_mtime_ns == before
    first.write_bytes(b"cut")  # a file of the same size is kept, any other is written again
    first.write_bytes(b"cu")
    extract(tmp_path / "p_1_all.deb", lambda name: name.endswith("a.txt"), tmp_path)
    assert first.read_bytes() == b"one"


def test_a_package_cannot_write_outside_of_the_folder(tmp_path):
    samples.deb(tmp_path / "p_1_all.deb", {"../../evil": b"x"})
    with pytest.raises(ValueError, match="leaves the package"):
        extract(tmp_path / "p_1_all.deb", lambda name: True, tmp_path / "out")
    assert not (tmp_path.parent / "evil").exists()


@pytest.mark.parametrize(
    "damage, message",
    [
        (lambda data: b"PK" + data[2:], "not a Debian package"),
        (lambda data: data[:100], "holds no data.tar, or is cut off"),
        (lambda data: data[:-60], "is cut off: data.tar.xz should have"),
        (lambda data: data[:-120] + b"\1" * 120, "not a complete Debian package"),
        (lambda data: data.replace(b"data.tar.xz ", b"data.tar.zst"), "has a compression that"),
    ],
)
def test_a_damaged_package_is_refused(tmp_path, damage, message):
    path = tmp_path / "p_1_all.deb"
    samples.deb(path, FILES)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ValueError, match=message):
        extract(path, lambda name: True, tmp_path / "out")


def test_a_package_is_found_by_its_name(tmp_path):
    for name in ("tool_1.0_all.deb", "tool_2.0_all.deb", "tool-extra_3.0_all.deb"):
        (tmp_path / name).touch()
    assert find_deb("tool", tmp_path) == tmp_path / "tool_2.0_all.deb"
    assert find_deb("other", tmp_path) is None
    assert find_deb("tool", tmp_path / "none") is None


def test_apt_is_asked_once(tmp_path, monkeypatch):
    asked = []

    def apt(command, cwd, **_):
        asked.append(command[-1])
        samples.deb(cwd / "tool_1%3a2_all.deb", FILES)
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(packages.shutil, "which", lambda _: "/usr/bin/apt-get")
    monkeypatch.setattr(packages.subprocess, "run", apt)
    assert download("tool", tmp_path) == tmp_path / "tool_1%3a2_all.deb"
    assert download("tool", tmp_path) == tmp_path / "tool_1%3a2_all.deb"
    assert asked == ["tool"]
    assert [path.name for path in tmp_path.iterdir()] == ["tool_1%3a2_all.deb"]


def test_without_apt_the_message_says_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setattr(packages.shutil, "which", lambda _: None)
    with pytest.raises(ValueError, match="packages.debian.org/tool .*--debs"):
        download("tool", tmp_path)


def test_the_error_of_apt_is_passed_on(tmp_path, monkeypatch):
    monkeypatch.setattr(packages.shutil, "which", lambda _: "/usr/bin/apt-get")
    failed = subprocess.CompletedProcess([], 100, "", "E: Unable to locate package tool\n")
    monkeypatch.setattr(packages.subprocess, "run", lambda *_, **__: failed)
    with pytest.raises(ValueError, match="Unable to locate package tool.*apt-get update"):
        download("tool", tmp_path)
