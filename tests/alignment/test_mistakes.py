"""Common mistakes and their messages: at most three lines, which say how to fix the mistake."""

from __future__ import annotations

import sys

import h5py
import numpy as np
import pytest

from cfr_jax import io
from cfr_jax.batch.checked_lines import line_of
from cfr_jax.cli import main
from cfr_jax.cli.shared import outputs

RNG = np.random.default_rng(0)
SCALED = np.diag([2.0, 2.0, 2.0, 1.0])

# The words of the command line, and a part of the message. The mistake is in the words or in the
# files that `place` makes.
MISTAKES = {
    # files
    "no such file": ("register none.ply b.ply", "none.ply: cannot be read: No such file"),
    "a folder for a file": ("register scans b.ply", "is a folder, wanted a file"),
    "an empty file": ("register empty.ply b.ply", "empty.ply: is empty"),
    "a picture": ("register photo.jpg b.ply", "unknown suffix '.jpg', wanted one of .ply .pcd"),
    "a file cut off": ("register cut.ply b.ply", "cut.ply: "),
    "words for numbers": ("register words.xyz b.ply", "words.xyz: "),
    "a cloud on its side": ("register side.npy b.ply", "transposed"),
    "only numbers that are none": (
        "register nan.npy b.ply",
        "nan.npy: all 5 points are NaN or infinite, wanted at least one that is not",
    ),
    "beyond any unit": ("register huge.npy b.ply", "wanted finite coordinates within"),
    "two points": ("register two.npy b.ply", "got 2 points, wanted at least 3"),
    "all in one place": ("register same.npy b.ply", "wanted a cloud with some extent"),
    # options
    "one file only": ("register a.ply", "required: TARGET\ntry cfr register --help"),
    "a command misspelled": ("regster a.ply b.ply", "choose from"),
    "an option misspelled": ("register a.ply b.ply --viw x.html", "try cfr"),
    "an option cut short": ("register a.ply b.ply --max 9", "try cfr"),
    "a negative seed": ("register a.ply b.ply --seed -1", "wanted an integer of at least 0"),
    "no points at all": ("register a.ply b.ply --max-points 0", "integer of at least 1"),
    "unknown weights": ("register a.ply b.ply --weights best", "shipped are object"),
    "other files as weights": ("register a.ply b.ply --weights a.ply", "a readable safetensors"),
    "no start": ("register a.ply b.ply --initial none.txt", "none.txt: cannot be read"),
    "a start of words": ("register a.ply b.ply --initial words.xyz", "wanted a 4x4 transform"),
    "a start that scales": ("register a.ply b.ply --initial scaled.npy", "a proper rotation"),
    # outputs
    "output of no format": ("register a.ply b.ply --out c.doc", "wanted a name that ends in .ply"),
    "output into nowhere": ("register a.ply b.ply --out no/c.ply", "there is no folder no"),
    "output is a folder": ("register a.ply b.ply --json scans", "is a folder, wanted a file"),
    "output is a device": ("register a.ply b.ply --json /dev/full", "wanted a file to write"),
    "a read-only place": ("register a.ply b.ply --out /proc/c.ply", "cannot be written to"),
    "output over input": ("register a.ply b.ply --out a.ply", "a.ply would be overwritten"),
    # extras that are missing
    "pictures without matplotlib": ("register a.ply b.ply --png p.png", 'install "cfr_jax[viz]"'),
    "completion without shtab": ("completion bash", 'pip install "cfr_jax[completion]"'),
    "a checkpoint without torch": ("convert model.pth --out w.safetensors", '"cfr_jax[torch]"'),
    "a shell nobody knows": ("completion csh", "choose from"),
    # convert, models
    "no checkpoint": ("convert none.pth --out w.safetensors", "none.pth"),
    "weights under another suffix": ("convert model.pth --out w.h5", "ends in .safetensors"),
    "no such model": ("models best", "shipped are object"),
    "nothing to reproduce": ("reproduce best", "shipped are object"),
    # batches
    "no such list": ("batch none.csv --out r.csv", "no file or folder none.csv"),
    "a list of nothing": ("batch empty.csv --out r.csv", "wanted lines of `source,target`"),
    "semicolons": ("batch semicolons.csv --out r.csv", "line 1: wanted `source,target`"),
    "three numbers": ("batch three.csv --out r.csv", "3 numbers after the two files, wanted 16"),
    "a truth that scales": ("batch scaled.csv --out r.csv", "got a matrix that is not rigid"),
    "other columns": ("batch columns.csv --out r.csv", "wanted 16 numbers after the two files"),
    "a binary list": ("batch binary.csv --out r.csv", "wanted a CSV list"),
    "a cloud for a list": ("batch a.ply --out r.csv", "wanted a CSV list of `source,target` lines"),
    "an empty folder": ("batch nothing --out r.csv", "it holds nothing\nwanted a CSV list"),
    "a folder of photos": ("batch photos --out r.csv", "it holds 1 .jpg\nwanted a CSV list"),
    "one cloud in a folder": ("batch single --out r.csv", "give --target FILE"),
    "shapes for pairs": ("batch shapes.h5 --out r.csv", "`evaluate.py` makes pairs from shapes"),
    "an unknown layout": ("batch scans --out r.csv --layout lidar", "wanted one of pair-list"),
    "the wrong layout": ("batch scans --out r.csv --layout kitti", "it holds 2 .ply"),
    "no such target": ("batch scans --out r.csv --target none.ply", "there is no file none.ply"),
    "a target too many": ("batch good.csv --out r.csv --target a.ply", "already names its targets"),
    "a table of no format": ("batch good.csv --out r.xlsx", "wanted a name that ends in .csv"),
    "the list as the table": ("batch good.csv --out good.csv", "would be overwritten"),
    "a folder as the table": ("batch good.csv --out dir.csv", "is a folder, wanted a file"),
    "shard five of four": ("batch good.csv --out r.csv --shard 5/4", "wanted I/N with I from 1"),
    "no cluster": ("batch good.csv --out r.csv --shard auto", "give --shard I/N instead"),
    "no workers": ("batch good.csv --out r.csv --workers 0", "an integer of at least 1"),
    "a file of theirs": ("batch good.csv --out theirs.csv", "choose another --out"),
    "other settings": ("batch good.csv --out begun.csv", "give the same options to continue"),
    "all files bad": ("batch bad.csv --out r.csv", "add --retry-failed"),
    # data
    "no corpus": ("data info none.h5", "A corpus is an HDF5 file"),
    "notes for a corpus": ("data info photo.jpg", "an HDF5 file of pairs, the folder"),
    "a sheet of clouds": ("data info scans --sheet s.png", "wanted a corpus of shapes"),
    "a sheet of no format": ("data info shapes.h5 --sheet s.jpg", "that ends in .png"),
    "no meshes": ("data build photos --out c.h5", "wanted files that end in .ply .off"),
    "too few points": ("data build photos --out c.h5 --points 2", "wanted at least 16"),
    "no packages": ("data open-cad --out c --debs none", "--debs: there is no folder none"),
}  # fmt: skip


@pytest.fixture
def place(tmp_path, monkeypatch):
    """The working directory, with every file that the mistakes need."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CFR_JAX_CACHE", "off")
    cloud = io.PointCloud(RNG.normal(size=(80, 3)))
    for name in ("scans", "nothing", "photos", "single", "dir.csv"):
        (tmp_path / name).mkdir()
    for name in ("a.ply", "b.ply", "scans/1.ply", "scans/2.ply", "single/1.ply"):
        io.write(tmp_path / name, cloud)
    arrays = {
        "side": RNG.normal(size=(3, 80)),
        "nan": np.full((5, 3), np.nan),
        "huge": 1e13 * RNG.normal(size=(9, 3)),
        "two": np.eye(3)[:2],
        "same": np.ones((9, 3)),
        "scaled": SCALED,
    }
    for name, array in arrays.items():
        np.save(tmp_path / f"{name}.npy", array)
    numbers = ",".join(map(str, SCALED.ravel()))
    texts = {
        "words.xyz": "one two three\n",
        "good.csv": "a.ply,b.ply\n",
        "empty.csv": "",
        "semicolons.csv": "source;target\na.ply;b.ply\n",
        "three.csv": "a.ply,b.ply,1,2,3\n",
        "scaled.csv": f"a.ply,b.ply,{numbers}\n",
        "columns.csv": "id,name,path\n1,chair,a.ply\n",
        "bad.csv": "empty.ply,b.ply\nempty.ply,a.ply\n",
        "theirs.jsonl": "my notes\n",
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    begun = {"format": "cfr_jax/batch/2", "made_with": {"weights": "0" * 64}}
    (tmp_path / "begun.jsonl").write_bytes(line_of(begun))
    for name in ("empty.ply", "photo.jpg", "photos/1.jpg"):
        (tmp_path / name).touch()
    (tmp_path / "photo.jpg").write_bytes(b"\xff\xd8\xff")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00\x80" * 9)
    (tmp_path / "model.pth").write_bytes(b"PK\x03\x04")
    (tmp_path / "cut.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-40])
    with h5py.File(tmp_path / "shapes.h5", "w") as file:
        file["data"] = file["normal"] = np.ones((2, 8, 3), np.float32)
        file["label"] = np.zeros(2, np.int64)
    # pretend that the extras are not installed
    monkeypatch.setattr(outputs, "can_draw", lambda: False)
    for name in ("shtab", "torch"):
        monkeypatch.setitem(sys.modules, name, None)
    return tmp_path


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_told_with_the_way_out(mistake, place, monkeypatch, capsys):
    # given
    words, said = MISTAKES[mistake]
    if "--sheet" in words:  # this mistake is not that matplotlib is missing
        monkeypatch.setattr(outputs, "can_draw", lambda: True)
    before = {path: path.read_bytes() for path in place.rglob("*") if path.is_file()}

    # when
    code = main(words.split())

    # then
    err = capsys.readouterr().err
    told = [line for line in err.splitlines() if not line.startswith("registering: ")]
    assert code == 2, err
    assert 1 <= len(told) <= 3 and all(told), err
    assert told[0].startswith("cfr") and "error: " in told[0] and "Traceback" not in err
    assert said in "\n".join(told)
    assert {path: path.read_bytes() for path in before} == before, "files were harmed"


def test_a_cloud_of_a_billion_units_is_no_mistake(place):
    """Such a cloud is not refused; `test_alignment` shows that units do not change the answer."""
    io.write(place / "far.ply", io.PointCloud(1e9 * RNG.normal(size=(80, 3))))
    from cfr_jax.alignment.planning import planned

    plan = planned(place / "far.ply", place / "far.ply")
    assert plan.frames.scale > 1e9 and np.abs(plan.source.points).max() < 2


def test_units_that_differ_are_remarked_on(place):
    from cfr_jax.alignment.doubts import warnings_of

    assert any("same units?" in text for text in warnings_of(None, (), 0.9, 0.9, 64, 1000.0, False))
