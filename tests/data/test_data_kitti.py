import shutil

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfr_jax.data import kitti
from cfr_jax.data.kitti import read_pairs, read_poses, scan_pair, select_frames


def motion(euler, translation):
    out = np.eye(4)
    out[:3, :3] = Rotation.from_euler("xyz", euler, degrees=True).as_matrix()
    out[:3, 3] = translation
    return out


FRAMES = 5
TO_CAMERA = motion([-90, 0, -90], [0.1, -0.2, 0.3])
TRUE_POSES = np.array([motion([0, 0, 4 * i], [6 * i, 0.5 * i, 0]) for i in range(FRAMES)])


def street(rng):
    """Ground, two walls and ten boxes around a 24 m drive along x."""
    ground = rng.uniform([-15, -9, -2], [40, 9, -2], (7000, 3))
    walls = rng.uniform([-15, 0, -2], [40, 0, 4], (6000, 3))
    walls[:, 1] = rng.choice([-9.0, 9.0], len(walls))
    boxes = []
    for _ in range(10):
        corner = rng.uniform([-12, -8, -2], [36, 6, -2])
        faces = rng.uniform(0, 2, (400, 3))
        faces[np.arange(400), rng.integers(0, 2, 400)] = rng.choice([0.0, 2.0], 400)
        boxes.append(corner + faces)
    return np.concatenate([ground, walls, *boxes])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A sequence whose recorded poses have errors of up to 0.2 m and half a degree."""
    folder = tmp_path_factory.mktemp("kitti")
    rng = np.random.default_rng(0)
    scans = folder / "sequences" / "03" / "velodyne"
    scans.mkdir(parents=True)
    world = street(rng)
    for frame, pose in enumerate(TRUE_POSES):
        back = np.linalg.inv(pose)
        seen = world[rng.random(len(world)) < 0.8]
        points = seen @ back[:3, :3].T + back[:3, 3]
        np.insert(points, 3, 0.5, axis=1).astype(np.float32).tofile(scans / f"{frame:06d}.bin")
    first = np.linalg.inv(TRUE_POSES[0])
    recorded = [
        TO_CAMERA
        @ first
        @ pose
        @ motion(rng.uniform(-0.5, 0.5, 3), rng.uniform(-0.2, 0.2, 3))
        @ np.linalg.inv(TO_CAMERA)
        for pose in TRUE_POSES
    ]
    line = " ".join(map(str, TO_CAMERA[:3].ravel()))
    calibration = folder / "sequences" / "03" / "calib.txt"
    calibration.write_text(f"P0: {line}\nTr: {line}\n")
    (folder / "poses").mkdir()
    lines = [" ".join(map(str, pose[:3].ravel())) for pose in recorded]
    (folder / "poses" / "03.txt").write_text("\n".join(lines) + "\n")
    return folder


def test_poses_come_in_the_frame_of_the_lidar(folder):
    poses = read_poses(folder, "03")

    np.testing.assert_allclose(poses, TRUE_POSES, atol=0.5)
    assert np.abs(poses - TRUE_POSES).max() > 0.01


def test_refined_truths_are_better_than_the_recorded_poses(folder):
    pairs = read_pairs(folder, "03", stride=1)

    np.testing.assert_array_equal(pairs.frames, [[0, 2], [1, 3], [2, 4]])
    poses = read_poses(folder, "03")
    for (source, target), found in zip(pairs.frames, pairs.transforms, strict=True):
        truth = np.linalg.inv(TRUE_POSES[target]) @ TRUE_POSES[source]
        recorded = np.linalg.inv(poses[target]) @ poses[source]
        assert np.abs(recorded - truth).max() > 0.05
        np.testing.assert_allclose(found, truth, atol=0.03)
    assert (pairs.fitness > 0.65).all()


def test_pairs_the_refinement_does_not_confirm_are_dropped(folder, tmp_path):
    moved = shutil.copytree(folder, tmp_path / "moved")
    scan = moved / "sequences" / "03" / "velodyne" / "000002.bin"
    (np.fromfile(scan, np.float32) + 500).tofile(scan)

    kept = read_pairs(moved, "03", stride=1)

    np.testing.assert_array_equal(kept.frames, [[1, 3]])


def test_frames_follow_the_published_walk():
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, 0, 3] = np.arange(40)

    np.testing.assert_array_equal(select_frames(poses), [[0, 11], [12, 23], [24, 35]])
    np.testing.assert_array_equal(select_frames(poses, stride=10), [[0, 11], [10, 21], [20, 31]])
    assert select_frames(poses, distance=100.0).shape == (0, 2)


def test_a_scan_pair_is_aligned_by_its_truth_and_repeats_itself(folder):
    pairs = read_pairs(folder, "03")

    pair, again = scan_pair(pairs, 0, points=2000), scan_pair(pairs, 0, points=2000)

    np.testing.assert_array_equal(pair.source, again.source)
    assert pair.source.shape == pair.target.shape == (2000, 3)
    assert pair.name == "03/000000-000002"
    back = np.linalg.inv(TRUE_POSES[2]) @ TRUE_POSES[0]
    world = pair.source @ pair.transform[:3, :3].T + pair.transform[:3, 3]
    original = (world - back[:3, 3]) @ back[:3, :3]
    on_ground = np.abs(original[:, 2] + 2) < 0.2
    assert on_ground.mean() > 0.3
    upright = pair.source_normals @ pair.transform[:3, :3].T @ back[:3, :3]
    # Ground normals face the sensor above, whatever the random motion.
    assert np.median(upright[on_ground][:, 2]) > 0.99


def test_scans_are_moved_up_to_fifteen_meters_and_45_degrees(folder):
    pairs = read_pairs(folder, "03", stride=1)

    for index in range(len(pairs)):
        motion = np.linalg.inv(scan_pair(pairs, index, 100).transform) @ pairs.transforms[index]
        assert np.abs(motion[:3, 3]).max() <= 15
        assert 0 <= np.degrees(np.arcsin(motion[0, 2])) <= 45
        assert np.linalg.norm(motion[:3, 3]) > 1


def test_truths_are_cached_and_recomputed_for_other_settings(folder, tmp_path):
    cache = tmp_path / "deep" / "03.npz"
    first = read_pairs(folder, "03", cache, stride=1)
    written = cache.stat().st_mtime_ns

    again = read_pairs(folder, "03", cache, stride=1)
    np.testing.assert_array_equal(again.transforms, first.transforms)
    assert cache.stat().st_mtime_ns == written
    assert len(read_pairs(folder, "03", cache)) == 1
    assert [file.name for file in cache.parent.iterdir()] == ["03.npz"]

    cache.write_bytes(b"broken")
    with pytest.raises(ValueError, match="03.npz cannot be read.*remove it"):
        read_pairs(folder, "03", cache)


def test_corrected_poses_do_not_use_the_old_cache(folder, tmp_path):
    moved = shutil.copytree(folder, tmp_path / "moved")
    first = read_pairs(moved, "03", tmp_path / "03.npz")
    (moved / "sequences" / "03" / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")

    assert not np.array_equal(read_poses(moved, "03")[1], read_poses(folder, "03")[1])
    again = read_pairs(moved, "03", tmp_path / "03.npz")

    assert len(again) == 0 or not np.array_equal(again.transforms, first.transforms)


def test_missing_or_broken_files_are_named(folder, tmp_path):
    with pytest.raises(ValueError, match="no .*07.txt.*cvlibs"):
        read_pairs(folder, "07")
    with pytest.raises(ValueError, match="no scan at .*000099.bin"):
        kitti.read_frame(folder, "03", 99)
    scans = tmp_path / "sequences" / "00" / "velodyne"
    scans.mkdir(parents=True)
    np.zeros(7, np.float32).tofile(scans / "000000.bin")
    with pytest.raises(ValueError, match="not a scan"):
        kitti.read_frame(tmp_path, "00", 0)
    (tmp_path / "poses").mkdir()
    (tmp_path / "poses" / "00.txt").write_text("1 2 3\n")
    with pytest.raises(ValueError, match="wanted 12 numbers per line"):
        read_poses(tmp_path, "00")
