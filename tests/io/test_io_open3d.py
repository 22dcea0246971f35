"""What Open3D writes is read, and what we write is read by Open3D."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys

import numpy as np
import pytest
from io_samples import normals, points, surface

from cfr_jax.io import PointCloud, read, write

CLOUDS = ("plain.xyz", "a.xyzn", "a.xyzrgb", "a.pts", "text.ply", "binary.ply", "text.pcd",
          "binary.pcd", "packed.pcd")  # fmt: skip
MESHES = ("a.obj", "a.stl", "a.off", "mesh.ply", "a.glb", "a.gltf")
WRITE = """
import sys, numpy as np, open3d as o3d
folder, clouds, meshes = sys.argv[1], sys.argv[2].split(), sys.argv[3].split()
held = np.load(folder + "/held.npz")
cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(held["points"]))
cloud.normals = o3d.utility.Vector3dVector(held["directions"])
cloud.colors = o3d.utility.Vector3dVector(np.full((len(held["points"]), 3), 0.2))
for name in clouds:
    assert o3d.io.write_point_cloud(
        f"{folder}/{name}", cloud, write_ascii="text" in name, compressed="packed" in name
    )
mesh = o3d.geometry.TriangleMesh(
    o3d.utility.Vector3dVector(held["vertices"]), o3d.utility.Vector3iVector(held["faces"])
)
mesh.compute_triangle_normals()
mesh.compute_vertex_normals()
for name in meshes:
    assert o3d.io.write_triangle_mesh(f"{folder}/{name}", mesh)
"""
READ = """
import sys, numpy as np, open3d as o3d
folder, names = sys.argv[1], sys.argv[2].split()
found = {}
for name in names:
    cloud = o3d.io.read_point_cloud(f"{folder}/{name}")
    found[name + " points"] = np.asarray(cloud.points)
    found[name + " normals"] = np.asarray(cloud.normals)
np.savez(folder + "/found.npz", **found)
"""

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("open3d") is None, reason="open3d is optional"
)


def run(code: str, *arguments: str) -> None:
    """Runs code in a process of its own: Open3D brings its own threads and warnings."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    child = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, env=environment
    )
    assert child.returncode == 0, child.stderr[-2000:]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A folder with what Open3D writes of a cloud and of a box."""
    folder = tmp_path_factory.mktemp("open3d")
    box = surface()
    np.savez(
        folder / "held.npz",
        points=points(), directions=normals(), vertices=box.vertices, faces=box.faces,
    )  # fmt: skip
    run(WRITE, str(folder), " ".join(CLOUDS), " ".join(MESHES))
    return folder


@pytest.mark.parametrize("name", CLOUDS)
def test_clouds_of_open3d_are_read(name, written):
    cloud = read(written / name)
    digits = 1e-5 if "text" in name else 1e-6  # six in text
    np.testing.assert_allclose(cloud.points, points(), atol=digits)
    if name.endswith((".ply", ".pcd", ".xyzn")):
        np.testing.assert_allclose(cloud.normals, normals(), atol=digits)


@pytest.mark.parametrize("name", MESHES)
def test_meshes_of_open3d_are_read(name, written):
    cloud = read(written / name, samples=2_000)
    away = np.abs((cloud.points - (1, 2, 3)) / (1, 2, 3)).max(axis=1)
    np.testing.assert_allclose(away, 1.0, atol=1e-5)


def test_open3d_reads_what_is_written_again(written, tmp_path):
    names = ("out.ply", "out.pcd")
    for source in ("binary.ply", "packed.pcd"):
        cloud = read(written / source, properties=True)
        for name in names:
            write(tmp_path / f"{source}.{name}", cloud)
    write(tmp_path / "bare.ply", PointCloud(points(), normals()))
    written_names = sorted(path.name for path in tmp_path.iterdir())
    run(READ, str(tmp_path), " ".join(written_names))
    with np.load(tmp_path / "found.npz") as found:
        for name in written_names:
            np.testing.assert_allclose(found[f"{name} points"], points(), atol=1e-6)
            np.testing.assert_allclose(found[f"{name} normals"], normals(), atol=1e-6)
