"""Files as programs really write them are read, and nothing is guessed without a word."""

from __future__ import annotations

import numpy as np
import pytest
from io_samples import normals, points, surface
from kind_samples import all_kinds, npy, npz, solids
from text_samples import LINES, ROWS, XYZ

from cfr_jax.io import CloudFileError, CloudWarning, read

KINDS = all_kinds()
# What each row without a point, two of them at most, is counted as.
HOLES = {
    "text: nan rows": 2, "text: PTX": 2, "ply: a row without a point": 1,
    "pcd: an infinite row": 1, "array: a row without a point": 1,
}  # fmt: skip


def put(folder, name: str, data: bytes | str):
    (folder / name).write_bytes(data.encode() if isinstance(data, str) else data)
    return folder / name


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_file_is_read_as_it_was_meant(kind, tmp_path):
    cloud = read(put(tmp_path, *KINDS[kind]))  # a warning would be an error

    np.testing.assert_allclose(cloud.points, points(), rtol=0, atol=1e-14)
    assert cloud.left_out == HOLES.get(kind, 0)
    if kind == "text: xyzn":
        np.testing.assert_allclose(cloud.normals, normals(), atol=1e-15)
    else:
        assert cloud.normals is None


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_file_is_read_the_same_with_its_properties(kind, tmp_path):
    path = put(tmp_path, *KINDS[kind])
    bare, whole = read(path), read(path, properties=True)
    np.testing.assert_array_equal(bare.points, whole.points)
    assert bare.table is None
    if not kind.startswith("mesh"):  # these have nothing but points
        assert len(whole.table.values[0]) == len(bare) + bare.left_out


SAID = {
    "a fourth column": ("a.txt", ROWS.replace("\n", " 7\n"), "first three of 4 columns"),
    "colors": ("a.txt", ROWS.replace("\n", " 255 0 0\n"), "not unit vectors"),
    "labels of ones": ("a.txt", ROWS.replace("\n", " 0 1 0\n"), "may as well be colors"),
    "decimal commas between blanks": ("a.txt", ROWS.replace(".", ","), "took commas for decimal"),
    "an index more than names": (
        "a.txt",
        "x y z\n" + "".join(f'"{k}" {line}\n' for k, line in enumerate(LINES)),
        "one name less than columns",
    ),
    "numbered columns of pandas": (
        "a.csv",
        ",0,1,2\n" + "".join(f"{k},{v.replace(' ', ',')}\n" for k, v in enumerate(LINES)),
        "left out the index",
    ),
    "vertices of an OBJ": ("a.obj", "v " + ROWS.strip().replace("\n", "\nv "), "has no faces"),
}


@pytest.mark.parametrize("case", SAID)
def test_what_was_read_by_a_rule_is_said(case, tmp_path):
    name, text, said = SAID[case]
    with pytest.warns(CloudWarning, match=said) as told:
        cloud = read(put(tmp_path, name, text))
    np.testing.assert_array_equal(cloud.points, points())
    assert cloud.normals is None and len(told) == len(cloud.notes) == 1


def column(values) -> list[str]:
    return [f"{value} {line}" for value, line in zip(values, LINES, strict=True)]


COMMAS = [line.replace(" ", ",") for line in LINES]
REFUSED = {
    "an index in front": ("a.txt", column(range(60)), "column 1 counts the rows"),
    "a time in front": ("a.txt", column(range(7, 607, 10)), "column 1 grows from row to row"),
    "a label in front": ("a.txt", column(k % 3 for k in range(60)), "column 1 holds whole numbers"),
    "other names": ("a.txt", ["a b c", *LINES], "no x and no y and no z among a, b, c"),
    "a name twice": ("a.csv", ["x,y,z,x", *COMMAS], "'x' 2 times"),
    "fewer names": ("a.csv", ["x,y,z", *(f"{line},1,2" for line in COMMAS)], "names 3 columns"),
    "units that differ": ("a.txt", ["x_mm y_mm z_m", *LINES], "different units"),
    "a comment on others": ("a.txt", ["# id t x y z", *column(range(60))], "a comment .* names 5"),
    "normals first": ("a.txt", [f"0 0.6 0.8 {line}" for line in LINES], "normals before the poi"),
    "a promise of more": ("a.pts", ["61", *LINES], "says in front that it has 61 points, holds 60"),
    "a row too wide": ("a.csv", ["x,y,z", *COMMAS[:4], "1,2,3,4"], "line 6: .* from 3 to 4"),
    "decimal commas as separators": ("a.csv", ["x,y,z", "1,5,2,5,3,5"], "names 3 .* have 6"),
    "two clouds": ("a.npz", npz(src=XYZ, ref=XYZ), "got 'ref', 'src'; FILE.npz:src names"),
    "three floats a row": ("a.bin", XYZ.astype("<f4").tobytes(), "no rows of 16 as in KITTI"),
    "a picture": ("a.npy", npy(np.zeros((6, 10, 3), np.uint8)), "an image"),
    "a cloud on its side": ("a.npy", npy(XYZ[:20].T.copy()), "transposed"),
    "planes of a grid": ("a.npy", npy(np.ones((3, 6, 100))), "transposed"),
    "a PTX cut off": ("a.ptx", ["2", "1", "0 0 0", "1 0 0"], "line 5: .* within the header"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_ambiguous_is_refused_and_the_message_says_how_to_say_it(case, tmp_path):
    name, content, said = REFUSED[case]
    data = content if isinstance(content, bytes) else "\n".join(content) + "\n"
    with pytest.raises(CloudFileError, match=said):
        read(put(tmp_path, name, data))


def test_the_user_says_what_the_columns_are(tmp_path):
    timed = put(tmp_path, "a.txt", "\n".join(column(range(60))) + "\n")
    for columns in ("time,x,y,z", "time x y z", ["time", "x", "y", "z"]):
        np.testing.assert_array_equal(read(timed, columns=columns).points, points())
    rows = np.c_[np.zeros(60), XYZ[:, ::-1]].astype("<f4")
    scan = put(tmp_path, "a.bin", rows.tobytes())
    np.testing.assert_array_equal(read(scan, columns="t,z,y,x").points, points())
    np.save(tmp_path / "a.npy", np.c_[normals(), XYZ])
    cloud = read(tmp_path / "a.npy", columns="nx,ny,nz,x,y,z")
    np.testing.assert_array_equal(cloud.points, points())
    np.testing.assert_allclose(cloud.normals, normals(), atol=1e-15)
    named = put(tmp_path, "a.ply", KINDS["ply: upper case"][1])
    np.testing.assert_array_equal(read(named, columns="z,y,x").points, points()[:, ::-1])


@pytest.mark.parametrize(
    ("name", "columns", "said"),
    [
        ("a.txt", "x,y", r"columns: has no z among x, y"),
        ("a.txt", "x,y,z,z", "'z' 2 times"),
        ("a.txt", ["x", "y", " "], "wanted names"),
        ("a.txt", "t,x,y,z,i", "got 5 names .* 3 columns"),
        ("a.bin", "x,y,z,i,j,k,l", "wanted rows of 28"),
        ("a.stl", "x,y,z", "STL files say themselves"),
        ("a.las", "x,y,z", "LAS files say themselves"),
    ],
)
def test_names_that_do_not_fit_are_refused(name, columns, said, tmp_path):
    path = put(tmp_path, name, ROWS)
    with pytest.raises(ValueError, match=said):
        read(path, columns=columns)


def test_a_solid_more_is_a_part_of_the_surface(tmp_path):
    cloud = read(put(tmp_path, "a.stl", solids()), samples=0)
    assert {tuple(row) for row in cloud.points} == {tuple(row) for row in surface().vertices}
    assert len(cloud) == 36


def test_an_array_of_an_archive_is_read_by_its_name(tmp_path):
    source, target = np.random.default_rng(0).normal(size=(2, 20, 3))
    np.savez(tmp_path / "pair.npz", src=source, ref=target, motion=np.eye(4))

    assert np.array_equal(read(tmp_path / "pair.npz:src").points, source)
    assert np.array_equal(read(f"{tmp_path}/pair.npz:ref").points, target)
    with pytest.raises(
        CloudFileError, match="no array 'tgt', wanted one of 'motion', 'ref', 'src'"
    ):
        read(tmp_path / "pair.npz:tgt")
