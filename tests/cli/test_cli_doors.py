"""Every door for users' files, and everything that is no file: exit 2, at once, in a few lines."""

from __future__ import annotations

import io
import os
import signal
import sys
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path

import batch_samples
import h5py
import numpy as np
import pytest

from cfr_jax.cli import main

DOORS = {
    "source": ("register it.ply t0.xyz", "it.ply"),
    "target": ("register s0.ply it.pcd", "it.pcd"),
    "initial": ("register s0.ply t0.xyz --initial it.txt", "it.txt"),
    "initial npy": ("register s0.ply t0.xyz --initial it.npy", "it.npy"),
    "initial json": ("register s0.ply t0.xyz --initial it.json", "it.json"),
    "weights": ("register s0.ply t0.xyz --weights it.safetensors", "it.safetensors"),
    "result": ("view it.json", "it.json"),
    "list": ("batch it.csv --out out.csv", "it.csv"),
    "pairs": ("batch it.h5 --out out.csv", "it.h5"),
    "target of all": ("batch clouds --target it.ply --out out.csv", "it.ply"),
    "journal": ("batch pairs.csv --out it.csv", "it.jsonl"),
    "shard": ("batch pairs.csv --out out.csv", "out.1-of-2.jsonl"),
    "data": ("data info it", "it"),
    "checkpoint": ("convert it.pth --out w.safetensors", "it.pth"),
    "tensors": ("convert it.safetensors --out w.safetensors", "it.safetensors"),
    "arrays": ("convert it.npz --out w.safetensors", "it.npz"),
}
KINDS = ("pipe", "device", "kernel", "folder", "socket", "huge", "damaged")


def put(kind: str, path: Path) -> None:
    """Something that is no file of data."""
    match kind:
        case "pipe":
            os.mkfifo(path)
        case "device":
            path.symlink_to("/dev/zero")
        case "kernel":
            path.symlink_to("/proc/self/status")
        case "folder":
            path.mkdir()
        case "socket":
            import socket

            with socket.socket(socket.AF_UNIX) as bound:
                bound.bind(path.name)
        case "huge":
            with open(path, "wb") as file:
                file.truncate(1 << 42)
        case "damaged":
            path.write_bytes(bytes(range(255, 0, -1)) * 9)


@contextmanager
def at_most(seconds: int):
    """Ends what hangs by an error that no door catches."""

    def late(*_):
        raise SystemError("it hangs")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with good pairs, whose answers cost nothing."""
    batch_samples.write_pairs(tmp_path, 2)
    (tmp_path / "clouds").mkdir()
    (tmp_path / "clouds" / "a.ply").write_bytes((tmp_path / "s0.ply").read_bytes())
    with h5py.File(tmp_path / "pairs.h5", "w") as file:
        file["pair/source"] = file["pair/target"] = np.eye(3)
    monkeypatch.setattr("cfr_jax.batch.stream.align_many", batch_samples.quick)
    monkeypatch.setattr("cfr_jax.cli.shared.report.align", None)  # no door lets it come so far
    monkeypatch.setenv("CFR_JAX_CACHE", "off")
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.skipif(sys.platform != "linux", reason="files of the kernel")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("door", DOORS)
def test_what_is_no_file_of_data_is_refused_at_once_at_every_door(door, kind, place):
    # given
    words, name = DOORS[door]
    put(kind, place / name)
    out, err = io.StringIO(), io.StringIO()

    # when
    with at_most(60), redirect_stdout(out), redirect_stderr(err):
        code = main(words.split())

    # then
    told = [line for line in err.getvalue().splitlines() if not line.startswith("registering: ")]
    assert code == 2, (out.getvalue(), told)
    assert 1 <= len(told) <= 3 and name.split(".")[0] in "".join(told)
    assert sum(map(len, told)) <= 600
