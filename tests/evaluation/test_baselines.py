"""Every baseline must find a motion that it can find, and say what it needs."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfr_jax.evaluation.baselines import NAMES, NoMotion, baseline
from cfr_jax.evaluation.baselines.start import initial
from cfr_jax.io import PointCloud
from cfr_jax.runtime.optional import require

LOCAL = {"distances": (0.3, 0.1)}
FEATURES = {"distance": 0.05, "normal_radius": 0.25, "feature_radius": 0.5}
# What each needs to find a motion of 12 degrees, and its library.
NEAR = {
    "icp": (LOCAL, "open3d"),
    "icp_plane": (LOCAL | {"normal_radius": 0.25}, "open3d"),
    "gicp": (LOCAL, "small_gicp"),
    "gicp_jax": ({"cut": 0.1, "normal_radius": 0.25}, "jax"),
}
# The same for any motion.
FAR = {
    "fgr": (FEATURES, "open3d"),
    "fgr_icp": (FEATURES | {"distances": (0.1,)}, "open3d"),
    "ransac": (FEATURES, "open3d"),
    "kiss_matcher": ({"voxel": 0.1, "thin": False}, "kiss_matcher"),
}


def blob(count: int = 900, seed: int = 0) -> PointCloud:
    """A closed surface without symmetries."""
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    x, y, z = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).T
    radius = 0.6 + 0.25 * np.sin(3 * x + 1) * np.cos(4 * y) + 0.15 * np.sin(5 * z + 2 * x)
    return PointCloud(np.stack([1.3 * x, y, 0.8 * z], axis=1) * radius[:, None])


def moved(cloud: PointCloud, angle: float) -> tuple[PointCloud, np.ndarray]:
    """The cloud in another order and place, and the motion onto the cloud as it was."""
    motion = np.eye(4)
    axis = np.array([1.0, 2.0, -1.0]) / np.sqrt(6)
    motion[:3, :3] = Rotation.from_rotvec(np.deg2rad(angle) * axis).as_matrix()
    motion[:3, 3] = [0.3, -0.2, 0.1]
    order = np.random.default_rng(1).permutation(len(cloud))
    back = np.linalg.inv(motion)
    return PointCloud(cloud.points[order] @ back[:3, :3].T + back[:3, 3]), motion


def needs(module: str) -> None:
    try:
        require(module)
    except ModuleNotFoundError as error:
        pytest.skip(str(error))


def assert_recovers(name: str, options: dict, angle: float, within: float) -> None:
    target = blob()
    source, truth = moved(target, angle)
    found = baseline(name)(source, target, **options)
    assert found.shape == (4, 4)
    assert found.dtype == np.float64
    left = Rotation.from_matrix(truth[:3, :3].T @ found[:3, :3]).magnitude()
    assert np.rad2deg(left) < within
    assert np.linalg.norm(found[:3, 3] - truth[:3, 3]) < 0.02


@pytest.mark.parametrize("name", NEAR)
def test_a_local_method_recovers_a_small_motion(name):
    options, module = NEAR[name]
    needs(module)
    assert_recovers(name, options, angle=12, within=0.2)


@pytest.mark.parametrize("name", FAR)
def test_a_global_method_recovers_a_large_motion(name):
    options, module = FAR[name]
    needs(module)
    assert_recovers(name, options, angle=110, within=3)


def test_local_methods_work_at_any_size_and_place():
    # given a street-sized cloud, with all lengths scaled alike
    target = blob()
    source, truth = moved(target, 12)
    large = [PointCloud(40 * cloud.points + [100, 0, 0]) for cloud in (source, target)]

    # when
    small = baseline("gicp_jax")(source, target, cut=0.1, normal_radius=0.25)
    found = baseline("gicp_jax")(*large, cut=4.0, normal_radius=10.0)

    # then
    np.testing.assert_allclose(found[:3, :3], small[:3, :3], atol=2e-5)
    offset = found[:3, :3] @ [100, 0, 0] + found[:3, 3] - [100, 0, 0]
    np.testing.assert_allclose(offset, 40 * small[:3, 3], atol=5e-3)


@pytest.mark.parametrize("name", ["fgr", "gicp", "kiss_matcher"])
def test_the_same_call_gives_the_same_answer(name):
    options, module = (NEAR | FAR)[name]
    needs(module)
    target = blob(400)
    source, _ = moved(target, 60)
    first, second = (baseline(name)(source, target, **options) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_given_normals_are_used():
    needs("open3d")
    # given a flat target whose normals claim to lie in its plane
    grid = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0)), axis=-1).reshape(-1, 2) / 10
    points = np.concatenate([grid, np.zeros((400, 1))], axis=1)
    target = PointCloud(points, np.tile([1.0, 0.0, 0.0], (400, 1)))
    source = PointCloud(points + [0, 0, 0.03])

    # when
    found = baseline("icp_plane")(
        source, target, distances=(0.05,), normal_radius=0.3, start="identity"
    )

    # then the plane that they span leaves the height free
    assert found[2, 3] == pytest.approx(0, abs=1e-3)


def test_the_identity_moves_nothing():
    cloud = blob(10)
    np.testing.assert_array_equal(baseline("identity")(cloud, cloud), np.eye(4))


def test_a_start_at_the_centroid_lays_the_centroids_on_each_other():
    source, target = blob(50), PointCloud(blob(60, seed=2).points + [5, 0, 0])
    motion = initial(source, target, "centroid")
    np.testing.assert_allclose(
        source.points.mean(axis=0) + motion[:3, 3], target.points.mean(axis=0)
    )
    np.testing.assert_array_equal(initial(source, target, "identity"), np.eye(4))


def test_kiss_matcher_gives_up_where_its_solution_is_not_valid(monkeypatch):
    needs("kiss_matcher")
    import kiss_matcher

    # in place of hard clouds: 40 random points end the process of version 1.0.2
    solver = SimpleNamespace(estimate=lambda *_: SimpleNamespace(valid=False))
    monkeypatch.setattr(kiss_matcher, "KISSMatcher", lambda _: solver)
    with pytest.raises(NoMotion, match="not valid"):
        baseline("kiss_matcher")(blob(10), blob(10), voxel=0.1)


def test_a_missing_library_is_told_in_one_line_with_the_way_out(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install .*baselines.*apt-get") as caught:
        baseline("icp")(blob(10), blob(10), distances=(0.1,))
    assert "\n" not in str(caught.value)


def test_an_unknown_baseline_is_refused():
    with pytest.raises(ValueError, match="name is 'magic', wanted one of identity"):
        baseline("magic")


def test_every_name_has_a_function():
    for name in NAMES:
        assert callable(baseline(name))
