"""Poses in the file formats of other programs, tested against the definitions of these formats."""

from __future__ import annotations

import numpy as np
import pytest
from multiway_samples import some_poses
from scipy.spatial.transform import Rotation

from cfr_jax.multiway.pose_files import read_poses, write_poses

NAMES = ("a.ply", "b 2.ply", "c.ply")


@pytest.fixture
def poses() -> dict[str, np.ndarray]:
    return dict(zip(NAMES, some_poses(3, seed=1), strict=True))


@pytest.mark.parametrize("file", ["p.json", "p.txt", "p.kitti", "p.tum"])
def test_poses_come_back_as_they_were_written(file, poses, tmp_path):
    write_poses(tmp_path / file, poses, NAMES)
    found = read_poses(tmp_path / file, NAMES)
    assert list(found) == list(NAMES)
    for name in NAMES:
        np.testing.assert_allclose(found[name], poses[name], atol=1e-14)


@pytest.mark.parametrize("file", ["images.txt", "p.conf"])
def test_poses_of_files_without_blanks_come_back(file, tmp_path):
    names = ("a.ply", "b.ply")
    poses = dict(zip(names, some_poses(3, seed=2)[1:], strict=True))
    write_poses(tmp_path / file, poses, names)
    for name, pose in read_poses(tmp_path / file, names).items():
        np.testing.assert_allclose(pose, poses[name], atol=1e-14)


def test_kitti_has_the_first_three_rows(poses, tmp_path):
    write_poses(tmp_path / "p.txt", poses, NAMES)
    table = np.loadtxt(tmp_path / "p.txt").reshape(-1, 3, 4)
    np.testing.assert_array_equal(table, [pose[:3] for pose in poses.values()])


def test_tum_has_the_number_the_place_and_the_quaternion(poses, tmp_path):
    left = {name: poses[name] for name in NAMES if name != "b 2.ply"}
    write_poses(tmp_path / "p.tum", left, NAMES)
    table = np.loadtxt(tmp_path / "p.tum")
    np.testing.assert_array_equal(table[:, 0], [0, 2])
    np.testing.assert_allclose(
        Rotation.from_quat(table[:, 4:]).as_matrix(), [pose[:3, :3] for pose in left.values()]
    )
    assert list(read_poses(tmp_path / "p.tum", NAMES)) == list(left)


def test_tum_with_real_times_is_in_order(poses, tmp_path):
    write_poses(tmp_path / "p.tum", poses, NAMES)
    lines = (tmp_path / "p.tum").read_text().splitlines()
    lines = [f"17{number}.5 {line.split(' ', 1)[1]}" for number, line in enumerate(lines)]
    (tmp_path / "p.tum").write_text("# time x y z\n" + "\n".join(lines))
    found = read_poses(tmp_path / "p.tum", NAMES)
    np.testing.assert_allclose(found["c.ply"], poses["c.ply"], atol=1e-14)


def test_colmap_maps_the_model_into_the_camera(tmp_path):
    pose = some_poses(2, seed=4)[1]
    write_poses(tmp_path / "images.txt", {"a.ply": pose}, ("a.ply",))
    cells = (tmp_path / "images.txt").read_text().split()
    w, x, y, z, *place = map(float, cells[1:8])
    back = np.linalg.inv(pose)
    np.testing.assert_allclose(Rotation.from_quat((x, y, z, w)).as_matrix(), back[:3, :3])
    np.testing.assert_allclose(place, back[:3, 3])
    assert cells[0] == "1" and cells[9] == "a.ply"


def test_the_bunny_s_conf_turns_the_other_way(tmp_path):
    # given: a line from the repository's own file, for a scan taken 45 degrees further
    (tmp_path / "bun.conf").write_text(
        "camera -0.0172 -0.0936 -0.734 -0.0461723 0.970603 -0.235889 0.0124573\n"
        "bmesh bun000.ply 0 0 0 0 0 0 1\n"
        "bmesh bun045.ply -0.0520211 -0.000383981 -0.0109223 "
        "0.00548449 -0.294635 -0.0038555 0.955586\n"
    )
    # when
    found = read_poses(tmp_path / "bun.conf", ("bun000.ply", "bun045.ply", "chin.ply"))
    # then
    np.testing.assert_array_equal(found["bun000.ply"], np.eye(4))
    wanted = Rotation.from_quat((0.00548449, -0.294635, -0.0038555, 0.955586)).inv().as_matrix()
    np.testing.assert_allclose(found["bun045.ply"][:3, :3], wanted, atol=1e-6)
    np.testing.assert_array_equal(
        found["bun045.ply"][:3, 3], (-0.0520211, -0.000383981, -0.0109223)
    )


@pytest.mark.parametrize(
    ("file", "text", "told"),
    [
        ("p.txt", "1 2 3\n", "line 1 has 3 numbers"),
        ("p.txt", "1 0 0 0 0 1 0 0 0 0 nan 0\n", "line 1"),
        ("p.txt", "1 0 0 0 0 2 0 0 0 0 1 0\n", "a.ply"),
        ("p.txt", "0 0 0 0 0 0 0 0\n", "no direction"),
        ("p.txt", 4 * "1 0 0 0 0 1 0 0 0 0 1 0\n", "scan 3"),
        ("p.json", '{"poses": {"z": 1}}', "none of the scans"),
        ("p.json", "[", "wanted poses"),
        ("p.json", "[1]", "wanted poses"),
        ("p.conf", "bmesh a.ply 1 2\n", "line 1"),
    ],
)
def test_a_file_without_poses_is_refused_by_name(file, text, told, tmp_path):
    (tmp_path / file).write_text(text)
    with pytest.raises(ValueError, match=told) as error:
        read_poses(tmp_path / file, NAMES)
    assert str(tmp_path / file) in str(error.value)
