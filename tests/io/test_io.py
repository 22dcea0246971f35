"""What `cfr_jax.io` reads is what was written: by others' libraries, by hand, and by itself."""

from __future__ import annotations

import struct
from pathlib import Path

import laspy
import numpy as np
import plyfile
import pytest
import trimesh
from io_samples import COUNT, normals, pcd, points, surface, write_clouds, write_las, write_meshes

from cfr_jax.io import CloudFileError, CloudWarning, PointCloud, read, write

CLOUDS = (
    "text.ply", "little.ply", "big.ply", "text.pcd", "binary.pcd", "compressed.pcd", "plain.xyz",
    "normals.txt", "named.csv", "plain.npy", "stored.npz", "deflated.npz", "velodyne.bin",
    "format0.las", "format3.las", "format6.las", "format7.las",
    "format0.laz", "format3.laz", "format6.laz", "format7.laz",
)  # fmt: skip
WITH_NORMALS = (
    "text.ply", "little.ply", "big.ply", "text.pcd", "binary.pcd", "compressed.pcd",
    "normals.txt", "plain.npy", "stored.npz",
)  # fmt: skip
MESHES = (
    "box_text.ply", "box.ply", "mixed.ply", "mixed_text.ply", "box.off", "box.obj", "box.stl",
    "box_text.stl", "box.glb", "moved.gltf", "box.g3d", "box.pie",
)  # fmt: skip


@pytest.fixture(scope="module")
def clouds(tmp_path_factory) -> dict[str, Path]:
    return write_clouds(tmp_path_factory.mktemp("clouds"))


@pytest.fixture(scope="module")
def meshes(tmp_path_factory) -> dict[str, Path]:
    return write_meshes(tmp_path_factory.mktemp("meshes"))


def test_the_lists_of_this_file_leave_no_sample_out(clouds, meshes):
    assert set(CLOUDS) == set(clouds)
    assert set(MESHES) == set(meshes)


@pytest.mark.parametrize("name", CLOUDS)
def test_points_and_normals_come_out_as_they_were_put_in(name, clouds):
    # when
    cloud = read(clouds[name])

    # then
    assert cloud.name == name and cloud.points.dtype == np.float64
    np.testing.assert_array_equal(cloud.points, points())
    if name in WITH_NORMALS:
        np.testing.assert_allclose(cloud.normals, normals(), atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1.0, atol=1e-15)
    else:
        assert cloud.normals is None


@pytest.mark.parametrize("name", MESHES)
def test_a_surface_is_sampled_on_its_faces_evenly_and_with_their_normals(name, meshes):
    # given a box about (1, 2, 3) with sides of 2, 4, 6
    center, half = np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.0, 3.0])

    # when
    cloud = read(meshes[name])

    # then the points lie on the sides their normals point out of
    assert len(cloud) == 10_000
    scaled = (cloud.points - center) / half
    np.testing.assert_allclose(np.abs(scaled).max(axis=1), 1.0, atol=1e-6)
    axes = np.argmax(np.abs(cloud.normals), axis=1)
    outward = np.take_along_axis(scaled * cloud.normals, axes[:, None], axis=1)
    np.testing.assert_allclose(outward, 1.0, atol=1e-6)
    # and each side has its share: 24, 12 and 8 of 88 on either end of an axis
    for axis, area in enumerate((24.0, 12.0, 8.0)):
        for sign in (-1, 1):
            on_side = np.count_nonzero(cloud.normals[:, axis] * sign > 0.5)
            assert on_side / 10_000 == pytest.approx(area / 88.0, abs=0.02)
    # and is covered evenly: uniform coordinates have this mean and deviation
    side = scaled[axes == 0][:, 1:]
    np.testing.assert_allclose(side.mean(axis=0), 0.0, atol=0.04)
    np.testing.assert_allclose(side.std(axis=0), 1 / np.sqrt(3), atol=0.02)


def test_the_seed_alone_decides_the_samples(meshes):
    first, again = (read(meshes["box.off"], samples=50, seed=3) for _ in range(2))
    other = read(meshes["box.off"], samples=50, seed=4)
    np.testing.assert_array_equal(first.points, again.points)
    assert len(first) == 50 and not np.array_equal(first.points, other.points)


@pytest.mark.parametrize("name", [name for name in MESHES if "mixed" not in name])
def test_no_samples_means_the_vertices_themselves(name, meshes):
    cloud = read(meshes[name], samples=0)
    expected = {tuple(row) for row in surface().vertices}
    assert {tuple(np.round(row, 5) + 0.0) for row in cloud.points} == expected


def test_samples_leave_a_cloud_as_it_is(clouds):
    assert len(read(clouds["little.ply"], samples=10)) == COUNT


@pytest.mark.parametrize("suffix", [".ply", ".xyz", ".txt", ".npy", ".npz"])
@pytest.mark.parametrize("with_normals", [False, True])
def test_what_is_written_is_read_back(suffix, with_normals, tmp_path):
    # given coordinates that need all digits of float64, far from the origin as maps have them
    xyz = np.random.default_rng(0).normal(size=(40, 3)) + [690_000.0, 5_336_000.0, 500.0]
    cloud = PointCloud(xyz, normals()[:40] if with_normals else None)

    # when
    write(tmp_path / f"cloud{suffix}", cloud)
    back = read(tmp_path / f"cloud{suffix}")

    # then
    np.testing.assert_array_equal(back.points, cloud.points)
    if with_normals:
        np.testing.assert_allclose(back.normals, cloud.normals, atol=1e-15)
    else:
        assert back.normals is None


def test_pcd_is_written_in_float32_unless_that_would_deform_the_cloud(tmp_path):
    # given clouds of an extent of a few meters, nearer and farther from their origin
    near = PointCloud(np.random.default_rng(0).normal(size=(60, 3)), normals())
    far = PointCloud(near.points + 1e6)
    write(tmp_path / "cloud.pcd", near)
    before = (tmp_path / "cloud.pcd").read_bytes()

    # when
    back = read(tmp_path / "cloud.pcd")
    with pytest.raises(CloudFileError, match=r"cloud\.pcd: PCD holds float32.* wanted \.ply"):
        write(tmp_path / "cloud.pcd", far)

    # then
    np.testing.assert_allclose(back.points, near.points, atol=3e-7)
    np.testing.assert_allclose(back.normals, near.normals, atol=1e-7)
    assert b"SIZE 4 4 4 4 4 4\n" in before and (tmp_path / "cloud.pcd").read_bytes() == before


def test_a_single_point_is_written_in_every_format(tmp_path):
    for suffix in (".ply", ".pcd", ".xyz", ".txt", ".npy", ".npz"):
        write(tmp_path / f"cloud{suffix}", PointCloud(np.array([[0.5, 1e6, -3.0]])))
        back = read(tmp_path / f"cloud{suffix}")
        np.testing.assert_array_equal(back.points, [[0.5, 1e6, -3.0]])


def test_other_libraries_read_the_ply_that_is_written(tmp_path):
    cloud = PointCloud(points(), normals())
    write(tmp_path / "cloud.ply", cloud)
    vertex = plyfile.PlyData.read(tmp_path / "cloud.ply")["vertex"]
    np.testing.assert_array_equal(np.c_[vertex["x"], vertex["y"], vertex["z"]], cloud.points)
    np.testing.assert_array_equal(np.c_[vertex["nx"], vertex["ny"], vertex["nz"]], cloud.normals)
    np.testing.assert_array_equal(trimesh.load(tmp_path / "cloud.ply").vertices, cloud.points)


def test_a_written_file_replaces_the_old_one_whole_or_not_at_all(tmp_path):
    # given a file, and a cloud whose writing fails halfway
    path = tmp_path / "cloud.ply"
    write(path, PointCloud(points()))
    before = path.read_bytes()
    broken = PointCloud(points())
    object.__setattr__(broken, "normals", np.zeros((1, 3)))

    # when
    with pytest.raises(ValueError):
        write(path, broken)

    # then
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_laz_of_several_chunks_equals_the_oracle(tmp_path):
    xyz = np.random.default_rng(1).integers(-9000, 9000, (120_000, 3)) / 1024
    for layout, version in ((1, "1.2"), (6, "1.4")):
        write_las(tmp_path / "cloud.laz", xyz, layout, version)
        expected = laspy.read(tmp_path / "cloud.laz").xyz
        np.testing.assert_array_equal(read(tmp_path / "cloud.laz").points, expected)


def test_empty_cells_of_an_organized_pcd_are_left_out_and_counted(tmp_path):
    # given a cloud whose rows 3 and 4 carry no point
    text = pcd("ascii").split(b"\n")
    for row in (14, 15):
        text[row] = b"nan nan nan 0 0 0 0 nan nan nan 5"
    (tmp_path / "cloud.pcd").write_bytes(b"\n".join(text))

    # when
    cloud = read(tmp_path / "cloud.pcd")

    # then
    assert cloud.left_out == 2
    np.testing.assert_array_equal(cloud.points, np.delete(points(), [3, 4], axis=0))
    np.testing.assert_allclose(cloud.normals, np.delete(normals(), [3, 4], axis=0), atol=1e-6)


@pytest.mark.parametrize("marker", ["nan nan nan", "0 0 0"])
def test_a_cloud_with_a_normal_missing_has_no_normals(marker, tmp_path):
    rows = f"0 0 0 1 0 0\n1 0 0 {marker}\n"
    head = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    text = f"ply\nformat ascii 1.0\nelement vertex 2\n{head}end_header\n{rows}"
    (tmp_path / "cloud.ply").write_text(text)
    assert read(tmp_path / "cloud.ply").normals is None


def test_three_more_columns_that_are_colors_are_no_normals_and_that_is_said(tmp_path):
    (tmp_path / "cloud.xyz").write_text("0 0 0 255 0 0\n1 1 1 0 128 0\n")
    with pytest.warns(CloudWarning, match=r"cloud\.xyz: columns 4 to 6 are not unit vectors"):
        assert read(tmp_path / "cloud.xyz").normals is None


@pytest.mark.parametrize(
    "text",
    [
        "\ufeff1,2,3\r\n4,5,6\r\n",
        "// X Y Z I\n\n1 2\t3 9\n  4 5 6 9 # last\n",
        "1;2;3\n4;5;6",
        '"X","Y","Z","label"\n1,2,3,tree\n4,5,6,house\n',
        "1 2 3\r4 5 6\r",
    ],
)
def test_text_is_understood_as_programs_write_it(text, tmp_path):
    (tmp_path / "cloud.TXT").write_bytes(text.encode())
    np.testing.assert_array_equal(read(tmp_path / "cloud.TXT").points, [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize("dtype", ["<f2", ">f4", "<i2", "|u1", "<i8"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_npy_of_every_number_type_and_order_is_read(dtype, order, tmp_path):
    array = np.asarray(np.arange(12).reshape(4, 3), dtype=dtype, order=order)
    np.save(tmp_path / "cloud.npy", array)
    np.testing.assert_array_equal(read(tmp_path / "cloud.npy").points, array)


def test_an_obj_counts_back_from_where_a_face_stands(tmp_path):
    text = "v 0 0 0\nv 1 0 0\n  v 0 1 0 \\\n\nf -3//1 -2//1 -1//1\nv 5 5 5 0.5 0.5 0.5\n"
    (tmp_path / "mesh.obj").write_text(text)
    cloud = read(tmp_path / "mesh.obj", samples=100)
    assert cloud.points.max() < 1.0
    np.testing.assert_array_equal(cloud.normals, [[0.0, 0.0, 1.0]] * 100)


def test_an_off_with_counts_glued_to_its_mark_is_read(tmp_path):
    (tmp_path / "mesh.off").write_text("OFF3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 255 0 0\n")
    np.testing.assert_array_equal(read(tmp_path / "mesh.off", samples=5).normals, [[0, 0, 1]] * 5)


def test_stl_text_and_binary_told_apart_by_size_even_if_both_say_solid(tmp_path):
    triangle = struct.pack("<12fH", 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0)
    (tmp_path / "mesh.stl").write_bytes(b"solid".ljust(80) + struct.pack("<I", 1) + triangle)
    np.testing.assert_array_equal(read(tmp_path / "mesh.stl", samples=0).points.sum(), 2.0)
