"""The merged cloud: the mean point of each cube, and the scan that a point came from."""

from __future__ import annotations

import numpy as np
import pytest
from multiway_samples import some_poses

from cfr_jax import io
from cfr_jax.geometry import motions
from cfr_jax.multiway import fusing


def shown(points: np.ndarray, pose: np.ndarray, normals: np.ndarray | None = None) -> io.PointCloud:
    """Points of the model, in the frame of a scan with this pose."""
    back = motions.inverse(pose)
    return io.PointCloud(
        motions.apply(back, points), None if normals is None else motions.rotate(back, normals)
    )


def test_a_point_is_the_mean_of_its_cube_and_knows_who_gave_most():
    # given: two cubes; scan 4 gives two points to the first, scan 9 one to each
    first, second = np.array([[0.1, 0.1, 0.1], [0.3, 0.1, 0.1]]), np.array([[0.2, 0.4, 0.1]])
    other = np.array([[1.5, 0.2, 0.2]])
    poses = some_poses(3, seed=3)
    scans = [
        (4, shown(first, poses[1]), poses[1]),
        (9, shown(np.concatenate([second, other]), poses[2]), poses[2]),
    ]
    # when: the grid begins at the mean of the first scan, rounded down to whole cubes
    found = fusing.fuse(scans, 1.0)
    # then
    order = np.argsort(found.points[:, 0])
    np.testing.assert_allclose(
        found.points[order], [np.mean([*first, *second], axis=0), other[0]], atol=1e-12
    )
    np.testing.assert_array_equal(found.scan[order], [4, 9])
    np.testing.assert_array_equal(found.count[order], [3, 1])


def test_fusing_in_many_pieces_is_fusing_at_once(monkeypatch):
    rng = np.random.default_rng(0)
    poses = some_poses(6, seed=5)
    points = rng.uniform(0, 5, (6, 400, 3))
    normals = rng.normal(size=(6, 400, 3))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    scans = [(k, shown(points[k], poses[k], normals[k]), poses[k]) for k in range(6)]
    whole = fusing.fuse(scans, 0.7)
    monkeypatch.setattr(fusing, "_COMPACTED", 100)
    pieces = fusing.fuse(scans, 0.7)
    np.testing.assert_allclose(pieces.points, whole.points, atol=1e-12)
    np.testing.assert_allclose(pieces.normals, whole.normals, atol=1e-9)
    np.testing.assert_array_equal(pieces.count, whole.count)
    assert whole.count.sum() == points.shape[0] * points.shape[1]


def test_far_from_the_origin_nothing_is_lost():
    pose = np.eye(4)
    pose[:3, 3] = (4e6, 5e6, 100.0)
    points = np.random.default_rng(1).uniform(0, 1, (50, 3))
    found = fusing.fuse([(0, io.PointCloud(points), pose)], 1e-4)
    order, wanted = np.lexsort(found.points.T), points + pose[:3, 3]
    np.testing.assert_allclose(found.points[order], wanted[np.lexsort(wanted.T)], atol=1e-8)


def test_estimated_normals_of_a_ball_point_outward():
    points = np.random.default_rng(2).normal(size=(3000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    found = fusing.fuse([(0, io.PointCloud(points), np.eye(4))], 0.05)
    along = np.einsum("ij,ij->i", found.normals, found.points)
    assert np.quantile(along, 0.05) > 0.95


@pytest.mark.parametrize(
    ("voxel", "told"), [(0.0, "positive"), (np.nan, "positive"), (1e-9, "at least")]
)
def test_a_voxel_that_cannot_be_used_is_refused(voxel, told):
    cloud = io.PointCloud(np.random.default_rng(0).normal(size=(20, 3)))
    with pytest.raises(ValueError, match=f"voxel: .*{told}"):
        fusing.fuse([(0, cloud, np.eye(4))], voxel)
