"""Files that are no clouds: the message names the file, the place, and what was wanted."""

from __future__ import annotations

import json
import os
import re
import struct
import sys
import warnings

import numpy as np
import pytest
from amplifying_meshes import document
from io_samples import moved_gltf, pcd, points, write_clouds, write_meshes

from cfr_jax.io import CloudFileError, CloudWarning, PointCloud, read, write

SUFFIXES = (
    ".ply", ".pcd", ".xyz", ".txt", ".asc", ".csv", ".xyzn", ".xyzrgb", ".pts", ".ptx", ".npy",
    ".npz", ".bin", ".las", ".laz", ".e57", ".off", ".obj", ".stl", ".glb", ".gltf",
)  # fmt: skip
PLY = "ply\nformat ascii 1.0\nelement vertex {n}\n" + "".join(
    f"property float {axis}\n" for axis in "xyz"
)
FACES = "element face {n}\nproperty list uchar int vertex_indices\n"


def refusal(path, **options) -> str:
    with pytest.raises(CloudFileError) as caught:
        read(path, **options)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and "\n" not in message
    return message.removeprefix(f"{path}: ")


PIE = "PIE 2\nTYPE 200\nLEVELS 1\nLEVEL 1\n"
TRIANGLE = PIE.replace("LEVEL 1\n", "") + "POINTS 3\n0 0 0\n1 0 0\n0 1 0\nPOLYGONS 1\n"


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("content", [b"", b"\n\n", b"\x00\xff" * 53, b"not a cloud\n", b"{}"])
def test_what_is_no_cloud_is_refused_in_every_format(suffix, content, tmp_path):
    path = tmp_path / f"cloud{suffix}"
    path.write_bytes(content)
    assert ("is empty" == refusal(path)) == (content == b"")


def test_every_sample_cut_off_anywhere_is_refused_or_read(tmp_path):
    samples = {**write_clouds(tmp_path), **write_meshes(tmp_path)}
    for name, path in samples.items():
        whole = path.read_bytes()
        for share in (0.05, 0.3, 0.6, 0.9):
            cut = tmp_path / f"cut{path.suffix}"
            cut.write_bytes(whole[: int(share * len(whole))])
            try:
                with warnings.catch_warnings():
                    # the cut may have taken the names of the columns, or all faces
                    warnings.simplefilter("ignore", CloudWarning)
                    cloud = read(cut)
            except CloudFileError:
                continue
            # Only formats that nowhere say how much there is.
            assert path.suffix in (".xyz", ".txt", ".csv", ".bin", ".obj"), name
            assert path.suffix == ".obj" or len(cloud) < len(points())


def test_missing_files_folders_and_pipes_are_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe.ply")
    (tmp_path / "folder.ply").mkdir()
    assert "No such file" in refusal(tmp_path / "missing.ply")
    assert "is a folder" in refusal(tmp_path / "folder.ply")
    assert "not a regular file" in refusal(tmp_path / "pipe.ply")


def test_an_unknown_suffix_is_answered_with_the_known_ones(tmp_path):
    (tmp_path / "cloud.abc").write_bytes(b"x")
    assert all(suffix in refusal(tmp_path / "cloud.abc") for suffix in SUFFIXES)
    with pytest.raises(CloudFileError, match=r"'\.las', wanted one of \.ply \.pcd"):
        write(tmp_path / "cloud.las", PointCloud(points()))
    with pytest.raises(CloudFileError, match="No such file"):
        write(tmp_path / "no" / "cloud.ply", PointCloud(points()))


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("a.ply", PLY.format(n=5) + "end_header\n1 2 3\n", "line 9: the file ends after 1 of 5"),
        ("a.ply", PLY.format(n=2) + "end_header\n1 2 3\n1 2 x\n", "line 9: .*'x'"),
        ("a.ply", PLY.format(n=2) + "end_header\n1 2 3\n4 5\n", "line 9"),
        ("a.ply", PLY.format(n=1) + "end_header\n1 2 nan\n", "all 1 points are NaN"),
        ("a.ply", PLY.format(n=1) + "end_header\n1 2 1e13\n", r"within ±1e\+12"),
        ("a.ply", PLY.format(n=0) + "end_header\n", "holds no points"),
        (
            "a.ply",
            PLY.format(n=3) + FACES.format(n=1) + "end_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n",
            "triangle 0 names vertex 7, wanted 0 to 2",
        ),
        (
            "a.ply",
            PLY.format(n=3) + FACES.format(n=1) + "end_header\n0 0 0\n1 0 0\n2 0 0\n3 0 1 2\n",
            "no area",
        ),
        (
            "a.ply",
            PLY.format(n=3) + FACES.format(n=1) + "end_header\n0 0 0\n1 0 0\n0 1 0\n9 0 1 2\n",
            "line 13: row 0 of element 'face'",
        ),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex x\nend_header\n", "line 3"),
        ("a.xyz", "1 2 3\n4 5\n", "line 2: .*columns changed"),
        ("a.xyz", "1 2 3\n4.5 5 x\n", "line 2: could not convert string 'x'"),
        ("a.csv", "x,y,z,label\n1,2,3,a\n4,x,6,b\n", "line 3: could not convert string 'x'"),
        ("a.xyz", "# c\n\n1 2 3\n4 1e13 6\n", "point 1"),
        ("a.xyz", "1 2\n3 4\n", "rows of x, y, z"),
        ("a.csv", "x,y,z\n1,,3\n", "line 2"),
        ("a.csv", "x,y,z\n", "no points"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n", "ends after 0 of 1 faces"),
        ("a.off", "OFF\n3 0 0\n0 0 0\n1 0 0\n0 1 0\n", "mesh without faces"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n4 0 1 2\n", "promises 4 corners"),
        ("a.obj", "v 0 0 0\nv 1 0\nf 1 2 3\n", "line 2"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 0\n", "names vertex -1"),
        (
            "a.pie",
            PIE + "POINTS 3\n0 0 0\n1 0 0\nPOLYGONS 0\n",
            "line 8: they end after 2 of 3 poi",
        ),
        ("a.pie", TRIANGLE + "200 3 0 1\n", "promises 3 corners, its line holds 2"),
        ("a.pie", TRIANGLE + "200 3 0 1 3\n", "behind line 7: a polygon names vertex 3 or 0, want"),
        ("a.pie", TRIANGLE + "G00 3 0 1 2\n", "behind line 7: a polygon does not begin with its"),
        ("a.pie", TRIANGLE + "200\n", "does not begin with its flags"),
        ("a.pie", TRIANGLE.replace("LEVELS 1", "LEVELS 2") + "200 3 0 1 2\n", "1 of 2 levels"),
        ("a.pie", PIE.replace("PIE 2", "PIE 5"), "starts with b'PIE 5.*, wanted 'PIE 2'"),
        ("a.pie", PIE + "POINTS 1\n0 0\n", "2 coordinates, wanted three"),
        ("a.pie", PIE.replace("LEVELS 1\n", ""), "no line 'POINTS n'"),
        ("a.stl", "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\n", "line 2: .*facet"),
    ],
)
@pytest.mark.parametrize("properties", [False, True])
def test_the_message_names_place_and_want(name, text, told, properties, tmp_path):
    (tmp_path / name).write_text(text)
    assert re.search(told, refusal(tmp_path / name, properties=properties))


def test_headers_that_promise_more_than_the_file_holds_are_refused_at_once(tmp_path):
    # given
    samples = {**write_clouds(tmp_path), **write_meshes(tmp_path)}
    las = bytearray(samples["format3.las"].read_bytes())
    las[107:111] = struct.pack("<I", 4_000_000_000)
    stl = bytearray(samples["box.stl"].read_bytes())
    stl[80:84] = struct.pack("<I", 4_000_000_000)
    g3d = bytearray(samples["box.g3d"].read_bytes())
    g3d[75:79] = struct.pack("<I", 4_000_000_000)
    npy = samples["plain.npy"].read_bytes().replace(b"(60, 6)", b"(60000000000, 6)")
    binary = pcd("binary").replace(b"WIDTH 60", b"WIDTH 6000000000")
    promises = {
        "p.ply": samples["little.ply"].read_bytes().replace(b"vertex 60", b"vertex 6000000000"),
        "p.pcd": binary.replace(b"POINTS 60", b"POINTS 6000000000"),
        "p.las": bytes(las),
        "p.stl": bytes(stl),
        "p.npy": npy,
        "p.g3d": bytes(g3d),
        "p.pie": samples["box.pie"].read_bytes().replace(b"POINTS 8", b"POINTS 800000000"),
    }
    for name, data in promises.items():
        (tmp_path / name).write_bytes(data)
        # then
        assert "00000" in refusal(tmp_path / name)


@pytest.mark.parametrize(
    ("place", "value", "told"),
    [
        (3, "<B", "version 3, wanted 4"),
        (4, "<H", "bytes stand behind 1 meshes"),
        (71, "<I", "mesh 0 has 0 frames"),
        (79, "<I", "wanted at least one frame and a multiple of three"),
        (-4, "<I", "mesh 1: a face names vertex 9, wanted 0 to 7"),
    ],
)
def test_a_g3d_that_contradicts_itself_is_refused(place, value, told, tmp_path):
    data = bytearray(write_meshes(tmp_path)["box.g3d"].read_bytes())
    number = {3: 3, 4: 1, 71: 0, 79: 14, -4: 9}[place]
    struct.pack_into(value, data, place % len(data), number)
    (tmp_path / "a.g3d").write_bytes(data)
    assert told in refusal(tmp_path / "a.g3d")


@pytest.mark.parametrize("value", [1e30, np.inf, -np.inf, np.nan])
@pytest.mark.parametrize(
    "name", ["little.ply", "binary.pcd", "velodyne.bin", "box.stl", "format3.las"]
)
def test_values_that_are_no_coordinates_are_refused_or_left_out_in_binary_too(
    name, value, tmp_path
):
    # given a sample whose first point is at `value` along x
    path = {**write_clouds(tmp_path), **write_meshes(tmp_path)}[name]
    data = bytearray(path.read_bytes())
    if name == "format3.las":
        data[155:163] = struct.pack("<d", value)  # the offset of all points
    else:
        first = read(path, samples=0).points[0]
        at = data.index(first.astype("<f4").tobytes())
        data[at : at + 4] = struct.pack("<f", value)
    path.write_bytes(data)

    # then rows without a point are left out; a surface needs all its vertices
    if not np.isfinite(value) and name in ("little.ply", "binary.pcd", "velodyne.bin"):
        cloud = read(path)
        assert cloud.left_out == 1
        np.testing.assert_array_equal(cloud.points, points()[1:])
    else:
        assert re.search("point 0 is|the offset is", refusal(path))


def test_an_archive_that_unfolds_to_far_more_than_itself_is_refused(tmp_path):
    np.savez_compressed(tmp_path / "bomb.npz", points=np.zeros((2_000_000, 3)))
    assert "2000000 points of float64 in " in refusal(tmp_path / "bomb.npz")


def test_pickled_objects_are_never_loaded(tmp_path):
    np.save(tmp_path / "cloud.npy", np.array([{}, 1], dtype=object), allow_pickle=True)
    assert "wanted floats or integers" in refusal(tmp_path / "cloud.npy")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda g: g["nodes"][1].update(children=[0]), "wanted a tree"),
        (lambda g: g["buffers"][0].update(uri="../secret.bin"), "in the same folder"),
        (lambda g: g["buffers"][0].update(uri="/etc/passwd"), "in the same folder"),
        (lambda g: g["accessors"][0].update(count=10**9), "accessor 0"),
        (lambda g: g.update(extensionsRequired=["KHR_draco_mesh_compression"]), "draco"),
        (lambda g: g["meshes"][0].update(primitives=[]), "mesh without faces"),
        (lambda g: g["scenes"][0].update(nodes=[True]), "nodes: wanted one of 2"),
    ],
)
def test_damaged_or_reaching_gltf_is_refused(change, told, tmp_path):
    document = json.loads(moved_gltf())
    change(document)
    (tmp_path / "mesh.gltf").write_text(json.dumps(document))
    assert told in refusal(tmp_path / "mesh.gltf")


def test_deep_json_is_refused_and_not_recursed_into(tmp_path):
    (tmp_path / "mesh.gltf").write_bytes(b"[" * 200_000)
    assert "JSON" in refusal(tmp_path / "mesh.gltf")


def test_laz_without_its_decoder_tells_how_to_get_it(tmp_path, monkeypatch):
    samples = write_clouds(tmp_path)
    monkeypatch.setitem(sys.modules, "lazrs", None)
    assert 'pip install "cfr_jax[io]"' in refusal(samples["format3.laz"])


def test_a_negative_number_of_samples_is_refused(tmp_path):
    with pytest.raises(ValueError, match="samples must be 0 or more, got -1"):
        read(tmp_path / "mesh.off", samples=-1)


def test_an_array_on_its_side_is_no_cloud_of_three_points(tmp_path):
    path = tmp_path / "side.npy"
    np.save(path, np.random.default_rng(0).normal(size=(3, 400)))

    assert "transposed" in refusal(path)


@pytest.mark.parametrize("name", ["x" * 5000, "a folder", "a pipe", "much of nothing", "\ud800"])
def test_names_that_cannot_be_opened_are_refused_alone_and_as_a_buffer(name, tmp_path):
    # given
    (tmp_path / "a folder.ply").mkdir()
    os.mkfifo(tmp_path / "a pipe.ply")
    with open(tmp_path / "much of nothing.ply", "wb") as stream:
        stream.truncate(200 << 30)  # bytes, none of them on the disk
    parts = document(buffers=[{"byteLength": 36, "uri": f"{name}.ply"}])
    (tmp_path / "a.gltf").write_text(json.dumps(parts))

    # then
    with pytest.raises(CloudFileError) as caught:
        read(tmp_path / f"{name}.ply")
    assert len(str(caught.value)) <= 600
    assert "buffer 0" in refusal(tmp_path / "a.gltf")
