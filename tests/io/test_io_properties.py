"""What goes in comes out: every property of a file is written again, and only points are moved."""

from __future__ import annotations

import laspy
import numpy as np
import pandas
import plyfile
import pytest
from io_samples import COUNT, normals, pcd, points, surface, write_las
from property_samples import SHIFT, TURN, TYPES, WRITABLE, column, columns_in, moved, put, rows

from cfr_jax.io import CloudWarning, read, write


@pytest.mark.parametrize("form", (".ply", ".pcd", ".npy", ".npz"))
def test_the_same_format_holds_every_column_to_the_bit(form, tmp_path):
    table = rows()
    source = put(tmp_path, form, table)

    write(tmp_path / f"out{form}", moved(read(source, properties=True)))

    found = columns_in(tmp_path / f"out{form}")
    if form == ".npz":
        found = {name: found[name] for name in table.dtype.names}  # an archive has no order
    assert list(found) == list(table.dtype.names)
    for name in table.dtype.names:
        assert found[name].dtype == table.dtype[name], name
        np.testing.assert_array_equal(found[name], column(name, table), err_msg=name)


@pytest.mark.parametrize("source_form", WRITABLE)
@pytest.mark.parametrize("form", WRITABLE)
def test_every_format_gives_its_columns_to_every_other_one(form, source_form, tmp_path):
    # given values that float32, too, holds as they are
    table = rows("f8")
    source = put(tmp_path, source_form, table)

    # when
    write(tmp_path / f"out{form}", moved(read(source, properties=True)))

    # then the same columns come back, in the same order, and the points where they have to lie
    back = read(tmp_path / f"out{form}", properties=True)
    np.testing.assert_array_equal(back.points, points() @ TURN.T + SHIFT)
    np.testing.assert_allclose(back.normals, normals() @ TURN.T, atol=1e-6)
    held = dict(zip(back.table.names, back.table.values, strict=True))
    for name, values in TYPES.items():  # text has as many digits as the type needs
        same = np.array_equal(held[name].astype(values.dtype), values)
        assert same and held[name].dtype.kind in (values.dtype.kind, "i"), name
    others = [name for name in table.dtype.names if name in TYPES]
    assert [name for name in held if name in TYPES] == others


def test_a_motion_that_moves_nothing_leaves_every_bit_of_a_column(tmp_path):
    source = put(tmp_path, ".ply", rows())
    write(tmp_path / "out.ply", moved(read(source, properties=True), np.eye(3), np.zeros(3)))
    assert (tmp_path / "out.ply").read_bytes() == source.read_bytes()


def test_the_faces_and_all_elements_of_a_ply_are_written_again(tmp_path):
    # given faces of different sizes with a color each, edges, and lists among the vertices
    table = rows()
    corners = np.empty(3, [("vertex_indices", object), ("flags", "u1")])
    corners["vertex_indices"] = [np.arange(n, dtype="i4") for n in (3, 5, 4)]
    corners["flags"] = [7, 8, 9]
    edges = np.array([(0, 1, 0.5), (2, 3, 0.25)], [("vertex1", "i4"), ("vertex2", "i4"),
                                                   ("weight", "f8")])  # fmt: skip
    lists = np.empty(COUNT, [("x", "f4"), ("seen", object), ("y", "f4"), ("z", "f4")])
    for axis in "xyz":
        lists[axis] = table[axis]
    lists["seen"] = [np.arange(k % 4, dtype="i2") for k in range(COUNT)]
    parts = [("vertex", lists), ("face", corners), ("edge", edges)]
    kinds = {"val_types": {"seen": "i2", "vertex_indices": "i4"}}
    elements = [plyfile.PlyElement.describe(rows_, name, **kinds) for name, rows_ in parts]
    plyfile.PlyData(elements).write(tmp_path / "a.ply")

    # when
    write(tmp_path / "b.ply", moved(read(tmp_path / "a.ply", properties=True)))

    # then
    back = plyfile.PlyData.read(tmp_path / "b.ply")
    for name, given in parts:
        for label in given.dtype.names:
            if label in "xyz":
                np.testing.assert_array_equal(back[name][label], column(label, table))
                continue
            for one, other in zip(back[name][label], given[label], strict=True):
                np.testing.assert_array_equal(one, other)
            assert back[name][label][0].dtype == given[label][0].dtype


@pytest.mark.parametrize("kind", ["obj", "stl", "off", "glb", "ply"])
def test_a_mesh_is_written_as_the_mesh_it_was(kind, tmp_path):
    surface().export(tmp_path / f"box.{kind}")

    write(tmp_path / "moved.ply", moved(read(tmp_path / f"box.{kind}", properties=True)))

    back = plyfile.PlyData.read(tmp_path / "moved.ply")
    corners = np.stack([back["vertex"][axis] for axis in "xyz"], axis=1)
    faces = corners[np.stack(back["face"]["vertex_indices"])]
    wanted = surface().vertices[surface().faces] @ TURN.T + SHIFT

    def ordered(triangles):
        return sorted(map(tuple, np.round(triangles, 5).reshape(-1, 9).tolist()))

    assert ordered(faces) == ordered(wanted)


def test_a_format_without_faces_gets_the_points_drawn_from_them_and_says_so(tmp_path):
    surface().export(tmp_path / "box.stl")
    cloud = moved(read(tmp_path / "box.stl", properties=True))
    for form in (".pcd", ".xyz", ".csv", ".npy", ".npz"):
        with pytest.warns(CloudWarning, match="no faces: wrote 10000 points drawn from them"):
            write(tmp_path / f"out{form}", cloud)
        np.testing.assert_allclose(read(tmp_path / f"out{form}").points, cloud.points, rtol=1e-6)


def test_what_a_format_cannot_hold_is_named(tmp_path):
    frame = pandas.DataFrame(points(), columns=["x", "y", "z"])
    frame["kind"], frame["stamp"] = "tall tree", 2**62 + np.arange(COUNT)
    frame.to_csv(tmp_path / "a.csv", index=False)
    cloud = read(tmp_path / "a.csv", properties=True)
    for form, lost in ((".ply", "kind, stamp"), (".pcd", "kind"), (".xyz", "kind")):
        with pytest.warns(CloudWarning, match=f"left out {lost}:"):
            write(tmp_path / f"out{form}", cloud)
    for form in (".csv", ".npy", ".npz"):
        write(tmp_path / f"out{form}", cloud)
        held = read(tmp_path / f"out{form}", properties=True).table
        values = dict(zip(held.names, held.values, strict=True))
        assert set(values["kind"]) == {"tall tree"}
        np.testing.assert_array_equal(values["stamp"], frame["stamp"])


def test_rows_without_a_point_stay_and_the_grid_with_them(tmp_path):
    # given an organized cloud with two empty cells
    table = rows()
    table["x"][[3, 7]] = np.nan
    write(tmp_path / "out.pcd", moved(read(put(tmp_path, ".pcd", table), properties=True)))

    # then
    text = (tmp_path / "out.pcd").read_bytes()
    assert b"\nWIDTH 10\nHEIGHT 6\n" in text
    back = read(tmp_path / "out.pcd", properties=True)
    assert back.left_out == 2 and len(back) == COUNT - 2
    np.testing.assert_array_equal(columns_in(tmp_path / "out.pcd")["ring"], table["ring"])


def test_fields_of_several_numbers_stay_together_in_pcd(tmp_path):
    (tmp_path / "a.pcd").write_bytes(pcd("binary").replace(b" _ ", b" histogram "))
    write(tmp_path / "b.pcd", read(tmp_path / "a.pcd", properties=True))
    text = (tmp_path / "b.pcd").read_bytes()
    assert b"FIELDS x y z histogram normal_x normal_y normal_z label\n" in text
    assert b"COUNT 1 1 1 4 1 1 1 1\n" in text
    assert text.partition(b"DATA binary\n")[2] == pcd("binary").partition(b"DATA binary\n")[2]


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize(("layout", "version"), [(3, "1.2"), (7, "1.4")])
def test_all_dimensions_of_las_come_out_under_the_names_of_laspy(suffix, layout, version, tmp_path):
    # given
    path = tmp_path / f"a{suffix}"
    write_las(path, points(), layout, version)
    cloud = laspy.read(path)
    cloud.add_extra_dim(laspy.ExtraBytesParams("height_above", "f4"))
    for k, name in enumerate(("intensity", "classification", "red", "gps_time", "user_data")):
        cloud[name] = (np.arange(COUNT) * (k + 1)) % 30
    cloud.return_number[:] = np.arange(COUNT) % 4 + 1
    cloud["height_above"] = np.linspace(0, 1, COUNT)
    cloud.write(path)

    # when
    write(tmp_path / "out.ply", read(path, properties=True))

    # then
    held = columns_in(tmp_path / "out.ply")
    expected = laspy.read(path)
    for name in expected.point_format.dimension_names:
        if name not in ("X", "Y", "Z"):
            np.testing.assert_array_equal(held[name], np.asarray(expected[name]), err_msg=name)
    for axis, wanted in zip("xyz", points().T, strict=True):
        np.testing.assert_array_equal(held[axis], wanted)


def test_coordinates_that_float32_would_deform_become_doubles(tmp_path):
    source = put(tmp_path, ".ply", rows())
    far = moved(read(source, properties=True), shift=[690_000.0, 5_336_000.0, 500.0])
    write(tmp_path / "out.ply", far)
    held = columns_in(tmp_path / "out.ply")
    assert held["x"].dtype == np.float64 and held["nx"].dtype == np.float32
    np.testing.assert_array_equal(read(tmp_path / "out.ply").points, far.points)


def old_loadtxt(data, dtype, *, delimiter, usecols, quotechar, **more):
    """What numpy before 2.4 does: it reads an integer via a float where it has to."""
    table = np.genfromtxt(data, "U64", delimiter=delimiter)[:, list(usecols)]
    made = np.zeros(len(table), dtype)
    for k, name in enumerate(dtype.names):
        values = np.char.strip(table[:, k], '"').astype("f8")
        with np.errstate(invalid="ignore"):
            made[name] = values.astype(dtype[name])
    return made


@pytest.mark.parametrize("delimiter", [" ", ",", ";", "\t"])
@pytest.mark.parametrize("mark", ["", '"'])
def test_a_column_is_integer_only_if_all_its_cells_are(delimiter, mark, tmp_path, monkeypatch):
    cells = {
        "x": ["1", "2.5", "3"],
        "y": ["4", "-3e2", "5"],
        "z": ["1", "2", "-3"],
        "huge": ["1", "9" * 20, "2"],
        "gap": ["1", "nan", "2"],
        "count": ["7", "+8", "9"],
    }
    lines = [cells, *zip(*cells.values(), strict=True)]
    text = [delimiter.join(f"{mark}{cell}{mark}" for cell in line) for line in lines]
    (tmp_path / "a.csv").write_text("\n".join(text) + "\n")
    monkeypatch.setattr(np, "loadtxt", old_loadtxt)

    table = read(tmp_path / "a.csv", properties=True).table

    read_back = dict(zip(table.names, table.values, strict=True))
    kinds = {name: read_back[name].dtype.kind for name in cells}
    assert kinds == {"x": "f", "y": "f", "z": "i", "huge": "f", "gap": "f", "count": "i"}
    for name, texts in cells.items():
        np.testing.assert_array_equal(read_back[name], np.array(texts, float), err_msg=name)
