"""Files that appear whole or not at all: what goes wrong is told by the name of the file."""

import errno
import os
import shutil

import pytest

from cfr_jax.runtime.atomic import unfinished, write_atomically


def test_a_full_disk_is_told_by_the_name_of_the_file_and_leaves_nothing(tmp_path, monkeypatch):
    def full(self, content):
        self.touch()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(OSError, match="No space left on device: '.*table.csv'"):
        write_atomically(tmp_path / "table.csv", b"abc")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_was_removed_meanwhile_is_told_by_the_name_of_the_file(tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    with pytest.raises(FileNotFoundError, match="'.*out/table.csv'"):
        with unfinished(folder / "table.csv") as beside:
            beside.write_bytes(b"abc")
            shutil.rmtree(folder)


def test_an_error_about_another_file_stays_as_it_is(tmp_path):
    with pytest.raises(FileNotFoundError, match="'.*other'"):
        with unfinished(tmp_path / "table.csv"):
            (tmp_path / "other").read_bytes()
