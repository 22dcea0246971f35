"""E57, as the library pye57 writes it, and what is said where that library is missing."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from io_samples import COUNT, points

from cfr_jax.io import CloudFileError, read


def write_scans(path, *, poses=((1.0, 0, 0, 0, 0, 0, 0),), holes=()):
    """A scan for each pose (quaternion and translation), whose points are `points()`."""
    pye57 = pytest.importorskip("pye57", reason="E57 is an extra")
    file = pye57.E57(str(path), mode="w")
    for pose in poses:
        data = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), points().T, strict=True))
        data["intensity"] = np.linspace(0, 1, COUNT)
        invalid = np.zeros(COUNT, np.int8)
        invalid[list(holes)] = 1
        if len(holes):
            data["cartesianInvalidState"] = invalid
        rotation, translation = np.array(pose[:4]), np.array(pose[4:])
        file.write_scan_raw(data, rotation=rotation, translation=translation)
    file.close()


def test_all_scans_are_read_in_the_common_frame(tmp_path):
    half = 0.5**0.5  # a quarter turn about z
    write_scans(tmp_path / "a.e57", poses=[(1, 0, 0, 0, 0, 0, 0), (half, 0, 0, half, 1, 2, 3)])

    cloud = read(tmp_path / "a.e57", properties=True)

    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    wanted = np.concatenate([points(), points() @ turn.T + [1, 2, 3]])
    np.testing.assert_allclose(cloud.points, wanted, atol=1e-5)
    intensity = cloud.table.values[cloud.table.names.index("intensity")]
    np.testing.assert_allclose(intensity, np.tile(np.linspace(0, 1, COUNT), 2), atol=1e-6)


def test_invalid_points_are_left_out_and_counted(tmp_path):
    write_scans(tmp_path / "a.e57", holes=(3, 7))
    cloud = read(tmp_path / "a.e57")
    assert cloud.left_out == 2
    np.testing.assert_allclose(cloud.points, np.delete(points(), [3, 7], axis=0), atol=1e-5)


def test_damaged_files_are_refused(tmp_path):
    write_scans(tmp_path / "a.e57")
    whole = (tmp_path / "a.e57").read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(60):
        data = bytearray(whole)
        for at in rng.integers(48, len(data), 3):
            data[at] ^= 1 << int(rng.integers(8))
        (tmp_path / "b.e57").write_bytes(data)
        with pytest.raises(CloudFileError, match=r"b\.e57"):  # every page has a checksum
            read(tmp_path / "b.e57")
    (tmp_path / "b.e57").write_bytes(whole[:-100])
    with pytest.raises(CloudFileError, match="byte 16: says"):
        read(tmp_path / "b.e57")


def test_without_the_library_the_message_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pye57", None)
    head = b"ASTM-E57" + bytes(8) + (48).to_bytes(8, "little") + bytes(24)
    (tmp_path / "a.e57").write_bytes(head)
    with pytest.raises(CloudFileError, match=r'pip install "cfr_jax\[e57\]"'):
        read(tmp_path / "a.e57")
