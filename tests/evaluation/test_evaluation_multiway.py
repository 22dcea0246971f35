"""Tables of merges: errors that are known, and every way on a small set."""

from __future__ import annotations

import json

import numpy as np
import pytest
from multiway_samples import some_poses, views_of_a_solid
from scipy.optimize import minimize

from cfr_jax import io
from cfr_jax.evaluation.multiway import errors, ways
from cfr_jax.evaluation.multiway.comparison import compare_merges
from cfr_jax.evaluation.multiway.config import MergeConfig
from cfr_jax.geometry import motions, twists


def test_poses_in_another_frame_have_no_error():
    truth = some_poses(6, seed=1)
    other = some_poses(2, seed=2)[1]
    found = errors.pose_errors(other @ truth, truth, np.random.default_rng(0).normal(size=(6, 3)))
    np.testing.assert_allclose(found.degrees, 0, atol=1e-6)
    np.testing.assert_allclose(found.lengths, 0, atol=1e-12)


def test_no_other_common_motion_is_nearer_to_the_truth():
    # given: poses with errors, in another frame
    truth, rng = some_poses(6, seed=3), np.random.default_rng(4)
    centers = rng.normal(size=(6, 3))
    poses = some_poses(2, seed=5)[1] @ truth @ twists.exp(rng.normal(0, 0.05, (6, 6)))
    found = errors.pose_errors(poses, truth, centers)

    # when: the sum of squared chords of the turns is minimized by search
    def chords(turn):
        laid = motions.from_rotvec(turn) @ poses[:, :3, :3]
        return np.sum((laid - truth[:, :3, :3]) ** 2)

    starts = [minimize(chords, start, tol=1e-12) for start in rng.normal(size=(12, 3))]
    best = min(starts, key=lambda each: each.fun)
    # then
    angles = np.radians(found.degrees)
    np.testing.assert_allclose(np.sum(8 * np.sin(angles / 2) ** 2), best.fun, rtol=1e-6)
    assert found.degrees.max() < 20 and found.lengths.max() < 0.5


def test_wrong_edges_are_counted_by_their_errors():
    truth = some_poses(3, seed=6)
    right = motions.inverse(truth[1]) @ truth[0]
    turned = right @ twists.exp(np.array([np.radians(12.0), 0, 0, 0, 0, 0]))
    moved = right @ twists.exp(np.array([0, 0, 0, 0, 0.2, 0]))
    edges = tuple((0, 1, each) for each in (right, turned, moved))
    found = ways.Placed(np.arange(3), truth, edges)
    assert errors.wrong_edges(found, truth, np.zeros((3, 3)), (10.0, 0.15)) == 2
    assert errors.wrong_edges(found, truth, np.zeros((3, 3)), (15.0, 0.15)) == 1


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sets")
    (folder / "solid").mkdir()
    clouds, poses = views_of_a_solid(4)
    names = [f"view{k}.ply" for k in range(4)]
    for name, cloud in zip(names, clouds, strict=True):
        io.write(folder / "solid" / name, io.PointCloud(cloud))
    held = dict(zip(names, poses.tolist(), strict=True))
    (folder / "solid" / "poses.json").write_text(json.dumps({"poses": held}))
    return folder


def test_every_way_has_its_row(sets, tmp_path):
    # given
    methods = ["merge", "chain"]
    try:
        import open3d  # noqa: F401

        methods.append("open3d")
    except (ImportError, OSError):  # its wheel needs libraries of the system
        pass
    config = MergeConfig(title="a test", data={"kind": "views", "path": str(sets)})
    # when
    table = compare_merges(config, tmp_path, methods, "the command")
    # then
    results = json.loads((tmp_path / "results.json").read_text())["methods"]
    assert list(results) == methods
    [ours] = results["merge"]
    assert ours["scans"] == ours["placed"] == ours["right"] == 4 and ours["wrong_edges"] == 0
    assert results["chain"][0]["edges"] == 3
    assert table == (tmp_path / "table.md").read_text()
    assert "| merge | 4 | 4 (100%) | 0 | 0 |" in table and "the command" in table


def test_frames_of_a_sequence_come_with_their_poses(tmp_path):
    # given: the layout of KITTI odometry
    scans = tmp_path / "sequences" / "00" / "velodyne"
    scans.mkdir(parents=True)
    (tmp_path / "poses").mkdir()
    poses = some_poses(3, seed=7)
    np.savetxt(tmp_path / "poses" / "00.txt", poses[:, :3].reshape(3, 12))
    for k in range(3):
        np.full((20, 4), k, "<f4").tofile(scans / f"{k:06d}.bin")
    # when
    from cfr_jax.evaluation.multiway.sets import read_sets

    [found] = read_sets({"kind": "kitti", "path": str(tmp_path)}, limit=2)
    # then
    assert [file.name for file in found.files] == ["000000.bin", "000001.bin"]
    np.testing.assert_allclose(found.poses, poses[:2])
    np.testing.assert_allclose(found.centers(), [[0, 0, 0], [1, 1, 1]])


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"data": {"kind": "pairs"}}, "data: kind"),
        ({"methods": ("merge", "magic")}, "methods"),
        ({"threshold": (0.0, 1.0)}, "threshold"),
        ({"limit": -1}, "limit"),
    ],
)
def test_a_config_that_cannot_be_used_is_refused_by_name(changes, told):
    with pytest.raises(ValueError, match=told):
        MergeConfig(**{"title": "t", "data": {"kind": "views"}} | changes)


def test_data_without_sets_are_refused(tmp_path):
    config = MergeConfig(title="t", data={"kind": "views", "path": str(tmp_path)})
    with pytest.raises(ValueError, match="no folder with a poses.json"):
        compare_merges(config, tmp_path / "out")
    with pytest.raises(ValueError, match="wanted some of merge, chain, open3d"):
        compare_merges(config, tmp_path / "out", ["gicp"])
