"""What users hold is taken as a point cloud, or refused in the words of their own argument."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from io_samples import normals, points, surface

import cfr_jax.io
from cfr_jax.io import CloudFileError, CloudWarning, PointCloud, as_point_cloud, write

BOX_CORNERS = {tuple(row) for row in surface().vertices}


def imitate(module: str, name: str, **attributes):
    """An object that looks as if it came from a class of that module."""
    return type(name, (SimpleNamespace,), {"__module__": module})(**attributes)


class Tensor:
    """As Open3D's and torch's: on a device, to be brought to the host."""

    def __init__(self, values) -> None:
        self.values = np.asarray(values)

    def cpu(self) -> Tensor:
        return self

    def numpy(self) -> np.ndarray:
        return self.values


class OnlyDlpack:
    """An array that speaks DLPack and nothing else."""

    def __init__(self, values: np.ndarray) -> None:
        self.values = values

    def __dlpack__(self, **options):
        return self.values.__dlpack__(**options)

    def __dlpack_device__(self):
        return self.values.__dlpack_device__()


class OnDevice:
    """An array that refuses to come to the host by itself, as torch's do on a GPU."""

    def __array__(self, *_, **__):
        raise TypeError("can't convert cuda:0 device type tensor to numpy")


CLOUDS = {
    "array": lambda: points(),
    "transposed view": lambda: np.asfortranarray(points()),
    "float32": lambda: points().astype(np.float32),
    "list": lambda: points().tolist(),
    "jax": lambda: jnp.asarray(points(), jnp.float32),
    "dlpack": lambda: OnlyDlpack(points()),
    "cloud": lambda: PointCloud(points(), name="mine"),
    "open3d": lambda: imitate(
        "open3d.cpu.pybind.geometry", "PointCloud", points=points(), normals=np.empty((0, 3))
    ),
    "open3d tensor": lambda: imitate(
        "open3d.cpu.pybind.t.geometry", "PointCloud", point={"positions": Tensor(points())}
    ),
    "trimesh": lambda: trimesh.PointCloud(points()),
}


@pytest.mark.parametrize("kind", CLOUDS)
def test_points_are_taken_as_they_are(kind):
    cloud = as_point_cloud(CLOUDS[kind](), name="source")
    np.testing.assert_array_equal(cloud.points, points())
    assert cloud.normals is None and cloud.points.dtype == np.float64
    assert cloud.name == ("mine" if kind == "cloud" else "source")


@pytest.mark.parametrize("dtype", [np.int8, np.uint16, np.int64, np.float16])
def test_whole_numbers_become_floats(dtype):
    array = np.arange(12).reshape(4, 3).astype(dtype)
    np.testing.assert_array_equal(as_point_cloud(array, name="source").points, array)


def test_one_point_is_a_cloud():
    assert len(as_point_cloud([[1, 2, 3]], name="source")) == 1


def test_columns_four_to_six_are_normals_scaled_to_unit_length():
    array = np.hstack([points(), 1.01 * normals()])
    cloud = as_point_cloud(array, name="source")
    np.testing.assert_array_equal(cloud.points, points())
    np.testing.assert_allclose(cloud.normals, normals(), atol=1e-15)


COLORS = np.random.default_rng(3).uniform(size=(60, 3))


@pytest.mark.parametrize(
    "last",
    [255 * COLORS, COLORS, np.eye(3)[COLORS.argmax(axis=1)], np.zeros((60, 3)), COLORS * np.nan],
    ids=["bytes", "shares", "labels", "zeros", "nan"],
)
def test_columns_four_to_six_that_are_colors_are_left_out_and_that_is_said(last):
    with pytest.warns(CloudWarning, match="^source: the last three of six columns are no unit"):
        cloud = as_point_cloud(np.hstack([points(), last]), name="source")
    np.testing.assert_array_equal(cloud.points, points())
    assert cloud.normals is None


def test_the_normals_of_open3d_are_kept():
    legacy = imitate(
        "open3d.cuda.pybind.geometry", "PointCloud", points=points(), normals=normals()
    )
    attributes = {"positions": Tensor(points()), "normals": Tensor(normals().astype("f4"))}
    tensor = imitate("open3d.cuda.pybind.t.geometry", "PointCloud", point=attributes)
    for cloud in (legacy, tensor):
        kept = as_point_cloud(cloud, name="source").normals
        np.testing.assert_allclose(kept, normals(), atol=1e-6)


MESHES = {
    "trimesh": surface,
    "trimesh scene": lambda: trimesh.Scene(surface()),
    "a class of one's own": lambda: type("Part", (trimesh.Trimesh,), {"__module__": "mine"})(
        surface().vertices, surface().faces
    ),
    "open3d": lambda: imitate(
        "open3d.cpu.pybind.geometry", "TriangleMesh",
        vertices=surface().vertices, triangles=surface().faces,
    ),
    "open3d tensor": lambda: imitate(
        "open3d.cpu.pybind.t.geometry", "TriangleMesh",
        vertex={"positions": Tensor(surface().vertices)},
        triangle={"indices": Tensor(surface().faces)},
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", MESHES)
def test_meshes_are_sampled_as_files_of_meshes_are(kind):
    mesh = MESHES[kind]()
    cloud = as_point_cloud(mesh, name="source", samples=500)
    assert len(cloud) == 500 and len(as_point_cloud(mesh, name="source")) == 10_000
    distance = np.abs((cloud.points - (1, 2, 3)) / (1, 2, 3)).max(axis=1)
    np.testing.assert_allclose(distance, 1.0, atol=1e-9)
    vertices = as_point_cloud(mesh, name="source", samples=0).points
    assert {tuple(row) for row in vertices} == BOX_CORNERS


def test_paths_are_read(tmp_path):
    write(tmp_path / "cloud.ply", PointCloud(points()))
    for path in (tmp_path / "cloud.ply", str(tmp_path / "cloud.ply")):
        cloud = as_point_cloud(path, name="source")
        assert cloud.name == "cloud.ply"
        np.testing.assert_array_equal(cloud.points, points())


NAN_ROW = [[0.0, 0, 0], [0, np.nan, 0]]
REFUSED = [
    (np.zeros((3, 10)), r"shape \(3, 10\), wanted \(n, 3\).*\.T\?"),
    (np.zeros((6, 10)), r"\.T\?"),
    (np.zeros((1, 10, 3)), r"did you mean \[0\]\?"),
    (np.zeros((2, 10, 3)), r"shape \(2, 10, 3\)"),
    (np.zeros((10, 4)), r"shape \(10, 4\)"),
    (np.zeros(3), r"shape \(3,\)"),
    (np.float64(1.0), r"shape \(\)"),
    (np.zeros((0, 3)), "holds no points"),
    ([], r"shape \(0,\)"),
    (NAN_ROW, r"point 1 is \(0, nan, 0\)"),
    ([[np.inf, 0.0, 0.0]], r"point 0 is \(inf, 0, 0\)"),
    ([[1e13, 0.0, 0.0]], r"finite coordinates within ±1e\+12"),
    (np.zeros((4, 3), bool), "of bool"),
    (np.zeros((4, 3), complex), "of complex128"),
    (np.zeros((4, 3), object), "of object"),
    ([["a", "b", "c"]], "a list of <U1"),
    ([[1.0, 2.0, 3.0], [4.0]], "a list, which is no array"),
    (None, "a NoneType of object"),
    ({"points": 1}, "a dict of object"),
    (b"cloud.ply", "a bytes of"),
    (OnDevice(), "which is no array .*cuda"),
    (imitate("open3d.cpu.pybind.geometry", "PointCloud", points=[], normals=[]), r"shape"),
    (imitate("open3d.cpu.pybind.t.geometry", "PointCloud", point={}), "holds no points"),
    (imitate("open3d.cpu.pybind.geometry", "TriangleMesh", vertices=np.zeros((3, 3)),
             triangles=np.zeros((0, 3), int)), "mesh without faces"),
]  # fmt: skip


@pytest.mark.parametrize(("value", "told"), REFUSED)
def test_what_is_no_cloud_is_refused_by_the_name_of_the_argument(value, told):
    with pytest.raises(ValueError, match=f"^target: .*{told}"):
        as_point_cloud(value, name="target")


def test_a_file_that_cannot_be_read_is_named_beside_the_argument():
    with pytest.raises(CloudFileError, match=r"^target: missing\.ply: .*No such file"):
        as_point_cloud("missing.ply", name="target")


def test_a_cloud_cannot_be_made_of_normals_for_other_points():
    with pytest.raises(ValueError, match=r"normals must have the shape \(60, 3\), got \(59, 3\)"):
        PointCloud(points(), normals()[1:])


def test_the_room_imports_little_of_the_package_and_nothing_that_only_some_files_need():
    folder = Path(cfr_jax.io.__file__).parent
    imported = {
        line.split()[1].partition(".")[0]
        for path in folder.rglob("*.py")
        for line in path.read_text().splitlines()
        if line.startswith(("import ", "from "))
    }
    ours = {
        line.split()[1]
        for path in folder.rglob("*.py")
        for line in path.read_text().splitlines()
        if line.startswith("from cfr_jax")
    }
    assert all(name.startswith(("cfr_jax.io", "cfr_jax.runtime")) for name in ours)
    third_party = {name for name in imported if name and name not in sys.stdlib_module_names}
    assert third_party == {"numpy", "jaxtyping", "cfr_jax"}


@pytest.mark.skipif(
    importlib.util.find_spec("open3d") is None, reason="open3d is optional; its imitations ran"
)
def test_the_real_open3d_agrees_with_its_imitations():
    # given, in a process of its own, since Open3D brings its own threads and warnings
    code = """
import numpy as np, open3d as o3d
from cfr_jax.io import as_point_cloud
xyz = np.random.default_rng(0).normal(size=(50, 3))
legacy = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz))
tensor = o3d.t.geometry.PointCloud(o3d.core.Tensor(xyz))
for cloud in (legacy, tensor):
    assert np.array_equal(as_point_cloud(cloud, name="a").points, xyz)
    assert as_point_cloud(cloud, name="a").normals is None
    cloud.estimate_normals()
    found = as_point_cloud(cloud, name="a").normals
    assert np.allclose(np.linalg.norm(found, axis=1), 1)
box = o3d.geometry.TriangleMesh.create_box()
for mesh in (box, o3d.t.geometry.TriangleMesh.from_legacy(box)):
    sampled = as_point_cloud(mesh, name="a", samples=100).points
    assert sampled.shape == (100, 3) and np.allclose(np.abs(sampled - 0.5).max(axis=1), 0.5)
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}

    # when
    child = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment
    )

    # then
    assert child.returncode == 0, child.stderr
