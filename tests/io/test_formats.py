"""The table of formats: everyone looks there, and a format from outside is one of them."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import cli_samples
import numpy as np
import pytest

from cfr_jax.cli import main
from cfr_jax.cli.shared import report
from cfr_jax.data.layout import recognize
from cfr_jax.data.making.items import folder_items
from cfr_jax.io import CloudFileError, PointCloud, as_point_cloud, formats, read, write
from cfr_jax.io.formats import Format
from cfr_jax.io.mesh import Mesh
from cfr_jax.io.table import table_of
from cfr_jax.weights.files import Weights

ROOT = Path(__file__).parents[2]
POINTS = np.random.default_rng(0).normal(size=(40, 3))


def parse_toy(data: bytes, name: str) -> PointCloud:
    """JSON in which the points stand upside down, so that no other format reads it."""
    if data[:1] != b"{":
        raise ValueError(f"byte 0: is {data[:1]!r}, wanted b'{{'")
    return PointCloud(np.array(json.loads(data)["points"])[::-1], None, name)


def save_toy(stream, cloud: PointCloud) -> None:
    stream.write(json.dumps({"points": cloud.points[::-1].tolist()}).encode())


def parse_toy_mesh(data: bytes, name: str, folder: Path) -> Mesh:
    """A line that names the file with the corners of one triangle."""
    corners = np.loadtxt(folder / data.decode().strip())
    return Mesh(corners, np.array([[0, 1, 2]]), name)


@pytest.fixture
def toys(monkeypatch):
    """The table with a format of clouds and one of surfaces more, for one test."""
    monkeypatch.setattr(formats, "_FORMATS", list(formats.entries()))
    formats.add(Format("toy", (".toy",), "cloud", parse_toy, save_toy, note="a toy"))
    formats.add(Format("toy mesh", (".toym",), "surface", parse_toy_mesh, needs_folder=True))


def test_a_format_from_outside_is_read_and_written(toys, tmp_path):
    write(tmp_path / "cloud.toy", PointCloud(POINTS))

    assert json.loads((tmp_path / "cloud.toy").read_text())["points"][0] == POINTS[-1].tolist()
    np.testing.assert_array_equal(read(tmp_path / "cloud.toy").points, POINTS)
    np.testing.assert_array_equal(
        as_point_cloud(tmp_path / "cloud.toy", name="source").points, POINTS
    )
    (tmp_path / "bad.toy").write_text("points")
    with pytest.raises(CloudFileError, match=r"bad\.toy: byte 0: is b'p', wanted"):
        read(tmp_path / "bad.toy")


def test_a_parser_that_gives_something_else_is_named_with_what_it_gave(toys, tmp_path):
    def parse_dots(data, name):
        return table_of(["x", "y", "z"], list(POINTS.T))

    formats.add(Format("dots", (".dots",), "cloud", parse_dots))
    (tmp_path / "one.dots").write_text("1 2 3")

    wanted = "^parse: that of the format 'dots' returned a Table, wanted a PointCloud or a Mesh"
    with pytest.raises(TypeError, match=wanted):
        read(tmp_path / "one.dots")


def test_a_surface_from_outside_is_sampled_and_knows_its_folder(toys, tmp_path):
    np.savetxt(tmp_path / "corners", [[0, 0, 1], [2, 0, 1], [0, 2, 1]])
    (tmp_path / "one.toym").write_text("corners\n")

    cloud = read(tmp_path / "one.toym", samples=50)

    np.testing.assert_allclose(cloud.points[:, 2], 1)
    np.testing.assert_allclose(cloud.normals, [[0, 0, 1]] * 50)
    assert [item.name for item in folder_items(tmp_path)] == ["one.toym"]


def test_cfr_register_reads_and_writes_a_format_from_outside(toys, tmp_path, monkeypatch, capsys):
    # given answers that cost nothing
    given = []

    def align(source, target, **options):
        given.append((source, target))
        return cli_samples.alignment(source, target)

    monkeypatch.setattr(report, "align", align)
    monkeypatch.setattr(report, "weights_of", lambda *_: Weights({}, "w", "cfr", "0" * 64, {}))
    source, target, moved = (tmp_path / f"{name}.toy" for name in ("source", "target", "moved"))
    write(source, PointCloud(POINTS))
    write(target, PointCloud(POINTS + 1))

    # when
    code = main(["register", str(source), str(target), "--out", str(moved)])

    # then
    assert code == 0
    [(first, second)] = given
    np.testing.assert_array_equal(first.points, POINTS)
    np.testing.assert_array_equal(second.points, POINTS + 1)
    motion = cli_samples.motion()
    np.testing.assert_allclose(read(moved).points, POINTS @ motion[:3, :3].T + motion[:3, 3])
    # and help and messages list it
    capsys.readouterr()
    assert main(["register", "--help"]) == 0
    told = " ".join(capsys.readouterr().out.split())  # lines break where it suits the width
    assert ".toy (a toy)" in told and re.search(r"surfaces .*\.toym", told)
    assert main(["register", str(source), str(target), "--out", "moved.abc"]) == 2
    assert ".npz .toy" in capsys.readouterr().err


def test_folders_of_a_format_from_outside_are_recognized(toys, tmp_path):
    for name in ("clouds/a.toy", "clouds/b.toy", "meshes/a.toym"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()

    assert recognize(tmp_path / "clouds").found == "2 point clouds (.toy)"
    assert recognize(tmp_path / "meshes").found == "1 meshes (.toym)"


def test_an_unknown_suffix_is_answered_with_all_known_ones(toys, tmp_path):
    (tmp_path / "cloud.abc").touch()
    listed = " ".join(formats.by_suffix(formats.entries()))
    assert listed.startswith(".ply .pcd ") and listed.endswith(" .toy .toym")
    with pytest.raises(CloudFileError, match=f"wanted one of {re.escape(listed)}$"):
        read(tmp_path / "cloud.abc")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"suffixes": (".new", ".ply")}, r"suffixes: \.ply is taken by PLY"),
        ({"suffixes": ("new",)}, r"suffixes: got \('new',\), wanted lower case"),
        ({"suffixes": (".NEW",)}, "wanted lower case"),
        ({"suffixes": ()}, "wanted lower case"),
        ({"holds": "clouds"}, "holds: got 'clouds', wanted one of 'cloud', 'surface', 'either'"),
        ({"holds": "either"}, "has_faces: mine holds 'either'"),
        ({"has_faces": bool}, "has_faces: mine holds 'cloud'"),
    ],
)
def test_a_format_that_does_not_fit_is_refused(unchecked, changes, message):
    about = {"name": "mine", "suffixes": (".new",), "holds": "cloud", "parse": parse_toy}
    before = formats.entries()
    with pytest.raises(ValueError, match=message):
        formats.add(Format(**(about | changes)))
    assert formats.entries() == before


def test_what_is_no_format_is_refused(unchecked):
    with pytest.raises(ValueError, match=r"^new: got '\.toy', wanted a Format"):
        formats.add(".toy")


@pytest.mark.parametrize("form", formats.entries(), ids=lambda form: form.name)
def test_every_format_of_the_table_has_what_the_table_names(form, tmp_path):
    folder = (tmp_path,) if form.needs_folder else ()
    with pytest.raises(ValueError):
        form.parse(b"\x00", "nothing", *folder)
    if form.save is not None:
        with open(tmp_path / "written", "wb") as stream:
            form.save(stream, PointCloud(POINTS))
        found = form.parse((tmp_path / "written").read_bytes(), "written")
        np.testing.assert_allclose(found.points, POINTS, rtol=1e-6)
    if form.has_faces is not None:
        assert not form.has_faces(b"\x00")


def test_the_tables_import_nothing_that_computes():
    code = """
import sys
from cfr_jax.data import kinds
from cfr_jax.io import formats
heavy = {"jax", "numpy", "scipy", "h5py"} & set(sys.modules)
import cfr_jax.io.coercion
sys.exit(f"{heavy}" if heavy else "jax" in sys.modules)
"""
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert (child.returncode, child.stderr) == (0, "")


@pytest.mark.parametrize(
    ("page", "listed"),
    [
        ("files.md", formats.entries()),
        ("train-on-your-data.md", [form for form in formats.entries() if form.loose]),
    ],
)
def test_the_pages_list_every_format(page, listed):
    text = (ROOT / "docs" / page).read_text("utf-8")
    assert [suffix for suffix in formats.by_suffix(listed) if suffix not in text] == []
