"""A folder of meshes gives one item per mesh, with the class that its folder or a list says."""

from __future__ import annotations

import random
import shutil
import warnings

import mesh_samples as samples
import numpy as np
import pytest
from io_samples import write_meshes
from mutants import mutate

from cfr_jax.data.corpus import read_corpus
from cfr_jax.data.making.build import build
from cfr_jax.data.making.items import folder_items, read_classes
from cfr_jax.data.making.mesh_formats import mesh_formats
from cfr_jax.data.making.meshes import read_mesh
from cfr_jax.data.making.shapes import make_shape
from cfr_jax.io.formats import by_suffix

CLA = """PSB 1
4 3

thing 0 0

seat thing 2
17
4

lamp 0 1
812

empty lamp 0
"""


def knot(seed):
    return samples.off(samples.knot(seed, 40, (1.0, 0.3 + 0.05 * seed, 0.4)))


@pytest.fixture
def benchmark(tmp_path):
    """The layout of the Princeton Shape Benchmark, with one model that no class lists."""
    for model in (4, 17, 812, 813):
        path = tmp_path / "db" / str(model // 100) / f"m{model}" / f"m{model}.off"
        path.parent.mkdir(parents=True)
        path.write_text(knot(model % 10))
    (tmp_path / "test.cla").write_text(CLA)
    return tmp_path


def test_a_classification_gives_the_class_wherever_the_mesh_lies(benchmark):
    items = folder_items(benchmark / "db", classes=benchmark / "test.cla")
    assert {item.name: item.category for item in items} == {
        "0/m17/m17.off": "seat",
        "0/m4/m4.off": "seat",
        "8/m812/m812.off": "lamp",
    }
    report = build(items, benchmark / "corpus", ("lamp",), 64, quiet=True)
    assert report.shapes == 3
    assert len(read_corpus(benchmark / "corpus/test.h5")) == 1


def test_a_listed_model_without_a_file_is_named_and_left_out(benchmark):
    shutil.rmtree(benchmark / "db/0/m4")
    items = folder_items(benchmark / "db", classes=benchmark / "test.cla")
    report = build(items, benchmark / "corpus", ("lamp",), 64, quiet=True)
    assert report.left_out == {
        "model 4": "cannot be read: test.cla lists it, but there is no file of that name"
    }


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("PSB 1", "PSB 2", "starts with 'PSB 2', wanted 'PSB 1'"),
        ("4 3", "4 x", "got 'x', wanted a count"),
        ("4 3", "4 4", "promises 4 models in 4 classes, lists 3 in 4"),
        ("seat thing 2", "seat chair 2", "class seat of chair must come once, after its parent"),
        ("lamp 0 1", "seat 0 1", "class seat of 0 must come once"),
        ("812", "17", "model 17 is in seat and in lamp"),
        ("empty lamp 0", "empty lamp 5", "ends after 0 of 5 models of the class empty"),
        ("empty lamp 0", "empty", "got '', wanted a count"),
    ],
)
def test_a_damaged_classification_is_refused_in_words(tmp_path, old, new, told):
    (tmp_path / "a.cla").write_text(CLA.replace(old, new))
    with pytest.raises(ValueError, match=f"^classes: .*a.cla: .*{told}"):
        read_classes(tmp_path / "a.cla")


def test_classes_of_other_meshes_are_refused(benchmark):
    (benchmark / "test.cla").write_text("PSB 1 1 1 seat 0 1 99")
    with pytest.raises(ValueError, match="classes: none of the 1 models .*'99' beside m17.off"):
        folder_items(benchmark / "db", classes=benchmark / "test.cla")
    with pytest.raises(ValueError, match="classes: .*none.cla"):
        folder_items(benchmark / "db", classes=benchmark / "none.cla")


def test_a_pattern_takes_some_files_and_hidden_ones_are_never_taken(tmp_path):
    # given ModelNet40's layout, with what an archiver left beside the meshes
    for name in ("bed/train/bed_1.off", "bed/test/bed_2.off", "sofa/test/sofa_1.OFF",
                 "bed/test/._bed_2.off", ".trash/test/bed_3.off"):  # fmt: skip
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(knot(1))

    # when
    items = folder_items(tmp_path, files="*/test/*")

    # then
    assert [(item.name, item.category) for item in items] == [
        ("bed/test/bed_2.off", "bed"),
        ("sofa/test/sofa_1.OFF", "sofa"),
    ]
    assert len(folder_items(tmp_path)) == 3
    with pytest.raises(
        ValueError, match="files: none of 3 meshes .* matches 'chair/.', such as bed"
    ):
        folder_items(tmp_path, files="chair/*")


def test_every_mesh_format_of_the_project_can_be_a_corpus(tmp_path):
    # given the same box in all formats that hold surfaces
    place = tmp_path / "box"
    place.mkdir()
    files = write_meshes(place)
    box = read_mesh(files["box.off"])
    (place / "box.ac").write_text(samples.ac3d(box))
    (place / "box.pmd").write_bytes(samples.pmd(box, np.ones((len(box.vertices), 3), "<f4")))
    assert {path.suffix for path in place.iterdir()} == set(by_suffix(mesh_formats()))

    # when
    items = folder_items(tmp_path, least_faces=12)
    report = build(items, tmp_path / "all.h5", None, 512, quiet=True)

    # then all were read, and are one shape
    assert len(items) == len(files) + 2
    assert report.shapes == 1 and set(report.reasons) == {"repeats another"}


def test_damaged_meshes_of_any_format_are_read_or_refused_in_words(tmp_path):
    box = samples.knot(0)
    files = {path.name: path.read_bytes() for path in write_meshes(tmp_path).values()}
    files["knot.ac"] = samples.ac3d(box).encode()
    files["knot.pmd"] = samples.pmd(box, box.vertices)
    refused = 0
    for case in range(100):
        for name, data in files.items():
            path = tmp_path / f"damaged{name[name.index('.') :]}"
            path.write_bytes(mutate(data, random.Random(f"{case} {name}")))
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                try:
                    make_shape(read_mesh(path), name, 64)
                except ValueError as error:
                    refused += 1
                    assert str(tmp_path) not in str(error)
    assert refused > 100


def test_objects_within_objects_without_end_are_refused(tmp_path):
    deep = "AC3Db\n" + "OBJECT group\nkids 1\n" * 5000
    (tmp_path / "deep.ac").write_text(deep)
    with pytest.raises(ValueError, match="wanted objects within at most 100 others"):
        read_mesh(tmp_path / "deep.ac")
