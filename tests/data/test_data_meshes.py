import zipfile

import mesh_samples as samples
import numpy as np
import pytest

from cfr_jax.data.making import furniture
from cfr_jax.data.making.ac3d import parse_ac3d
from cfr_jax.data.making.furniture import CATALOG, FurnitureLibrary
from cfr_jax.data.making.mesh_formats import mesh_formats
from cfr_jax.data.making.meshes import parse_pmd, read_mesh
from cfr_jax.io.formats import by_suffix

KNOT = samples.knot(0)
OUTWARD = KNOT.vertices / np.linalg.norm(KNOT.vertices, axis=1, keepdims=True)


def volume(mesh):
    """Signed: positive if the faces wind counter-clockwise seen from outside."""
    a, b, c = (mesh.vertices[mesh.triangles[:, corner]] for corner in range(3))
    return np.einsum("ij,ij->i", np.cross(a, b), c).sum() / 6


@pytest.mark.parametrize("sets", [0, 1, 3])
def test_pmd_gives_the_triangles_whatever_the_texture_coordinates(sets):
    mesh = parse_pmd(samples.pmd(KNOT, OUTWARD, sets), "knot")
    np.testing.assert_array_equal(mesh.vertices, KNOT.vertices.astype(np.float32))
    np.testing.assert_array_equal(mesh.triangles, KNOT.triangles)


def test_pmd_faces_are_wound_to_agree_with_the_normals_of_their_vertices():
    flipped = type(KNOT)(KNOT.vertices, KNOT.triangles[:, ::-1].copy(), "flipped")
    assert volume(flipped) < 0 < volume(KNOT)
    mesh = parse_pmd(samples.pmd(flipped, OUTWARD), "flipped")
    assert volume(mesh) == pytest.approx(volume(KNOT), rel=1e-5)


@pytest.mark.parametrize(
    "damage, message",
    [
        (lambda data: data[:10], "got 10 bytes, wanted a PMD file"),
        (lambda data: b"PSMB" + data[4:], "b'PSMB'"),
        (lambda data: data[:4] + b"\3" + data[5:], "version 3"),
        (lambda data: data[:500], "ends within its 30 vertices"),
        (lambda data: data[:-30], "ends within its .* faces"),
        (lambda data: data[:16] + b"\xff\xff\xff\xff" + data[20:], "ends within its 30 vertices"),
        (lambda data: data[:-14] + b"\xff\xff" + data[-12:], "names vertex 65535 of 30"),
    ],
)
def test_a_damaged_pmd_is_refused(damage, message):
    data = samples.pmd(KNOT, OUTWARD)
    with pytest.raises(ValueError, match=message):
        parse_pmd(damage(data), "knot")


AC3D = """AC3Db
MATERIAL "one" rgb 1 1 1
OBJECT world
kids 2
OBJECT group
loc 10 0 0
rot 0 1 0 -1 0 0 0 0 1
data 9
kids 9
no
kids 1
OBJECT poly
loc 0 0 5
numvert 4
0 0 0
1 0 0 0.5 0.5
1 1 0
0 1 0
numsurf 3
SURF 0x20
mat 0
refs 4
0 0 0
1 0 0
2 0 0
3 0 0
SURF 0x22
mat 0
refs 2
0 0 0
2 0 0
SURF 0x10
refs 3
0 0 0
1 0 0
2 0 0
kids 0
OBJECT poly
numvert 3
0 0 0
0 0 1
0 1 0
numsurf 1
SURF 0x10
refs 3
0 0 0
1 0 0
2 0 0
kids 0
"""


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_ac3d_places_objects_by_the_tree_and_leaves_lines_out(end):
    mesh = parse_ac3d(AC3D.replace("\n", end).encode("latin1"), "tree")
    # The group turns x into y and y into -x, then shifts by 10; its child shifts first.
    square = [[10, 0, 5], [10, 1, 5], [9, 1, 5], [9, 0, 5]]
    np.testing.assert_allclose(mesh.vertices[:4], square, atol=1e-12)
    np.testing.assert_array_equal(mesh.vertices[4:], [[0, 0, 0], [0, 0, 1], [0, 1, 0]])
    assert mesh.triangles.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2], [4, 5, 6]]


def test_ac3d_may_declare_more_children_than_it_has():
    text = samples.ac3d(KNOT).replace("kids 1", "kids 3", 1)
    mesh = parse_ac3d(text.encode(), "knot")
    np.testing.assert_array_equal(mesh.vertices, KNOT.vertices)


@pytest.mark.parametrize(
    "old, new, message",
    [
        ("AC3Db", "AC4D", "wanted 'AC3D'"),
        ("1 0 0 0.5 0.5", "1 0", "line 16: wanted 3 numbers, got 2"),
        ("refs 4", "refs -4", "line 20: wanted SURF, mat and refs"),
        ("SURF 0x20", "SURF 2x0", "line 20: wanted the flags of a surface"),
        ("loc 0 0 5", "loc 0 0 e", "line 13: wanted 3 numbers, got '0 0 e'"),
        ("numvert 4", "numvert 9", "line 19: they end after 4 of 9 vertices"),
        ("3 0 0\nSURF 0x22", "4 0 0\nSURF 0x22", "line 26: a surface names vertex 4 of 4"),
        ("2 0 0\nkids 0\nOBJECT poly", "2 0 0\nOBJECT poly", "wanted 'kids' before"),
        (
            "refs 3\n0 0 0\n1 0 0\n2 0 0\nkids 0\n",
            "refs 9\n0 0 0\n",
            "wanted the index of a corner",
        ),
        ("kids 2", "kids 2\njunk", "wanted OBJECT or MATERIAL, got 'junk'"),
    ],
)
def test_a_damaged_ac3d_is_refused_with_its_line(old, new, message):
    assert old in AC3D
    with pytest.raises(ValueError, match=message):
        parse_ac3d(AC3D.replace(old, new, 1).encode(), "tree")


def test_every_kind_of_file_gives_the_same_mesh(tmp_path):
    contents = {
        ".off": samples.off(KNOT).encode(),
        ".obj": samples.obj(KNOT).encode(),
        ".ac": samples.ac3d(KNOT, location=(0, 0, 0)).encode(),
        ".pmd": samples.pmd(KNOT, OUTWARD),
    }
    for suffix, content in contents.items():
        assert suffix in by_suffix(mesh_formats())
        path = tmp_path / f"knot{suffix.upper()}"
        path.write_bytes(content)
        mesh = read_mesh(path)
        np.testing.assert_allclose(mesh.vertices, KNOT.vertices, rtol=1e-6)
        np.testing.assert_array_equal(mesh.triangles, KNOT.triangles)


def test_a_file_that_is_not_a_mesh_is_refused(tmp_path):
    cloud = tmp_path / "cloud.ply"
    header = "ply\nformat ascii 1.0\nelement vertex 1\n"
    cloud.write_text(
        header + "".join(f"property float {a}\n" for a in "xyz") + "end_header\n0 0 0\n"
    )
    with pytest.raises(ValueError, match="got a point cloud, wanted a mesh"):
        read_mesh(cloud)
    with pytest.raises(ValueError, match="unknown suffix '.jpg'"):
        read_mesh(tmp_path / "cloud.jpg")
    with pytest.raises(ValueError, match="cannot be read"):
        read_mesh(tmp_path / "none.off")


def test_a_furniture_library_gives_pieces_at_their_true_size(tmp_path):
    path = tmp_path / "library.sh3f"
    samples.sh3f(path, {"Lib#chair": ("Ch\xe4ir", "Seats", KNOT), "Lib#b": ("Bed", "Beds", KNOT)})
    with FurnitureLibrary(path) as library:
        chair, bed = library.pieces
        assert (chair.identifier, chair.name, chair.category) == ("Lib#chair", "Ch\xe4ir", "Seats")
        assert bed.size == (2.0, 1.0, 0.505)  # width, height, depth: centimeters in the catalog
        mesh = library.mesh(chair)
    np.testing.assert_array_equal(mesh.triangles, KNOT.triangles)
    scaled = chair.scaled(mesh)
    np.testing.assert_allclose(np.ptp(scaled.vertices, axis=0), chair.size)
    np.testing.assert_allclose(scaled.vertices.max(axis=0), -scaled.vertices.min(axis=0))


def test_a_model_may_be_a_zip_in_the_zip(tmp_path):
    inner, path = tmp_path / "inner.zip", tmp_path / "library.sh3f"
    with zipfile.ZipFile(inner, "w") as archive:
        archive.writestr("readme.txt", "no model")
        archive.writestr("deep/model.obj", samples.obj(KNOT))
    entry = "name#7=A\nmodel#7=/m.zip\nwidth#7=1\ndepth#7=1\nheight#7=1\nid#7=x\\u00e9\\:y\n"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(CATALOG, entry)
        archive.write(inner, "m.zip")
    with FurnitureLibrary(path) as library:
        (piece,) = library.pieces
        assert piece.identifier == "x\xe9:y"
        np.testing.assert_array_equal(library.mesh(piece).triangles, KNOT.triangles)


@pytest.mark.parametrize(
    "catalog, message",
    [
        (None, "not a furniture library"),
        ("name#1=A\nmodel#1=/m.obj\n", "lacks \\['width', 'depth', 'height'\\]"),
        ("name#1=A\nmodel#1=/m\nwidth#1=wide\ndepth#1=1\nheight#1=1\n", "not a number"),
    ],
)
def test_a_damaged_library_is_refused(tmp_path, catalog, message):
    path = tmp_path / "library.sh3f"
    with zipfile.ZipFile(path, "w") as archive:
        if catalog is not None:
            archive.writestr(CATALOG, catalog)
    with pytest.raises(ValueError, match=message):
        FurnitureLibrary(path)


def test_what_unpacks_to_more_than_a_model_has_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(furniture, "LARGEST_MODEL", 1000)
    path = tmp_path / "library.sh3f"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(CATALOG, "\n" * 1001)

    with pytest.raises(ValueError, match="unpacks to 1001 bytes, wanted at most 1000"):
        FurnitureLibrary(path)


def test_a_missing_model_is_reported_when_it_is_read(tmp_path):
    path = tmp_path / "library.sh3f"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(CATALOG, "name#1=A\nmodel#1=m.obj\nwidth#1=1\ndepth#1=1\nheight#1=1\n")
    with FurnitureLibrary(path) as library, pytest.raises(ValueError, match="cannot read m.obj"):
        library.mesh(library.pieces[0])
