import mesh_samples as samples
import numpy as np
import pytest

from cfr_jax.data.corpus import read_corpus
from cfr_jax.data.making import build as building
from cfr_jax.data.making.build import build, choose_unseen, split_of
from cfr_jax.data.making.difference import compare
from cfr_jax.data.making.items import folder_items
from cfr_jax.data.making.samples import Item

POINTS = 600
CATEGORIES = ("chair", "lamp", "table")


def knot(seed):
    """A knot whose proportions depend on `seed`, so that a few points distinguish the knots."""
    scale = (1.0, 0.25 + 0.06 * seed, 0.25 + 0.06 * (5 * seed % 12))
    return samples.knot(seed, 40, scale)


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    """Four shapes in each of three categories, and some meshes that are not fit."""
    folder = tmp_path_factory.mktemp("meshes")
    for seed in range(12):
        path = folder / CATEGORIES[seed % 3] / "deep" / f"{seed}.off"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(samples.off(knot(seed)))
    (folder / "lamp/broken.off").write_text("OFF\n3 1")
    (folder / "lamp/twice.obj").write_text(samples.obj(knot(4)))
    (folder / "lamp/readme.md").write_text("not a mesh")
    small = samples.knot(3, vertices=5)
    (folder / "table/small.off").write_text(samples.off(small))
    return folder


def make(folder, out, unseen=("lamp",), points=POINTS):
    return build(folder_items(folder), out, unseen, points, quiet=True)


def contents(out):
    return {path.name: path.read_bytes() for path in sorted(out.iterdir())}


def test_a_folder_becomes_three_splits(meshes, tmp_path):
    out = tmp_path / "corpus"
    report = make(meshes, out)
    train, val, test = (read_corpus(out / f"{split}.h5") for split in ("train", "val", "test"))
    assert len(train) + len(val) == 8 and len(test) == 4 and report.shapes == 12
    assert {test.categories[label] for label in test.labels} == {"lamp"}
    assert "lamp" not in {train.categories[label] for label in train.labels}
    for corpus, split in ((train, "train"), (val, "val"), (test, "test")):
        assert corpus.categories == CATEGORIES
        for name, label in zip(corpus.names, corpus.labels, strict=True):
            assert name.split("/")[0] == corpus.categories[label]
            assert split_of(name, unseen=name.startswith("lamp/")) == split
        np.testing.assert_allclose(corpus.points.mean(axis=1), 0, atol=1e-3)
        radii = np.linalg.norm(corpus.points, axis=2).max(axis=1)
        np.testing.assert_allclose(radii, 1, atol=1e-3)
    assert not list(tmp_path.glob(".*"))  # no temporary files are left


def test_points_lie_on_the_mesh_they_are_named_after(meshes, tmp_path):
    make(meshes, tmp_path / "corpus")
    corpus = read_corpus(tmp_path / "corpus/test.h5")
    row = corpus.names.index("lamp/deep/1.off")
    points, normals = corpus[row]
    hull = knot(1)
    corners = hull.vertices[hull.triangles]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    # Each normal is that of a face, and points with the same normal lie in one plane.
    face = np.argmax(normals @ outward.T, axis=1)
    np.testing.assert_allclose(normals, outward[face], atol=0.02)
    for one in np.unique(face):
        heights = points[face == one] @ outward[one]
        assert np.ptp(heights) < 4e-3  # rounding to half precision


def test_meshes_that_are_left_out_are_listed_with_their_reason(meshes, tmp_path):
    report = make(meshes, tmp_path / "corpus")
    assert report.left_out == {
        "lamp/broken.off": "cannot be read: line 2: the file ends after 0 of 3 vertices",
        "table/small.off": "fewer than 20 faces with an area",
        "lamp/twice.obj": "repeats lamp/deep/4.off",
    }
    assert report.reasons["repeats another"] == report.reasons["cannot be read"] == 1
    lines = report.left_out_file.read_text().splitlines()
    assert lines == [f"{name}: {why}" for name, why in sorted(report.left_out.items())]


def test_the_same_meshes_give_the_same_bytes(meshes, tmp_path):
    for name in "ab":
        make(meshes, tmp_path / name)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_an_interrupted_build_resumes_to_the_same_bytes(meshes, tmp_path, monkeypatch):
    monkeypatch.setattr("cfr_jax.data.making.samples._BLOCK", 4)
    make(meshes, tmp_path / "whole")
    calls = []

    def failing(items, stop):
        def load(item):
            calls.append(item.name)
            if len(calls) > stop:
                raise KeyboardInterrupt
            return item.load()

        return [
            Item(i.name, i.category, lambda i=i: load(i), i.least_faces, i.stamp) for i in items
        ]

    out = tmp_path / "resumed"
    with pytest.raises(KeyboardInterrupt):
        build(failing(folder_items(meshes), 10), out, ("lamp",), POINTS, quiet=True)
    assert not out.exists()
    sampled = len(calls)
    build(failing(folder_items(meshes), 10**6), out, ("lamp",), POINTS, quiet=True)
    assert len(calls) - sampled == 15 - 8  # whole blocks are not sampled again
    assert contents(out) == contents(tmp_path / "whole")


def test_changed_meshes_are_sampled_again(meshes, tmp_path, monkeypatch):
    out = tmp_path / "corpus"
    items = folder_items(meshes)
    monkeypatch.setattr(building, "drop_duplicates", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        build(items, out, ("lamp",), POINTS, quiet=True)
    monkeypatch.undo()
    other = Item(items[0].name, items[0].category, lambda: samples.knot(77), stamp="new")
    build([other, *items[1:]], out, ("lamp",), POINTS, quiet=True)
    make(meshes, tmp_path / "before")
    assert contents(out) != contents(tmp_path / "before")


def test_a_shape_does_not_depend_on_the_others(meshes, tmp_path):
    items = folder_items(meshes)
    build(items, tmp_path / "all", ("lamp",), POINTS, quiet=True)
    build(items[::2], tmp_path / "some", ("lamp",), POINTS, quiet=True)
    whole, some = (read_corpus(tmp_path / name / "train.h5") for name in ("all", "some"))
    for row, name in enumerate(some.names):
        np.testing.assert_array_equal(some.points[row], whole.points[whole.names.index(name)])


def test_one_file_holds_all(meshes, tmp_path):
    report = make(meshes, tmp_path / "all.h5", unseen=None)
    assert len(read_corpus(tmp_path / "all.h5")) == report.shapes == 12
    beside = ["all.h5", "all.left_out.txt", "shape_names.txt"]
    assert sorted(path.name for path in tmp_path.iterdir()) == beside


def test_an_older_build_is_replaced_whole_or_not_at_all(meshes, tmp_path, monkeypatch):
    # given a corpus with a test split
    out = tmp_path / "corpus"
    make(meshes, out)
    before = contents(out)

    # when another build fails while it writes, then the older one is as it was
    with monkeypatch.context() as patched:
        patched.setattr(building, "_write_corpus", lambda path, *_: path.touch() or 1 / 0)
        with pytest.raises(ZeroDivisionError):
            make(meshes, out, unseen=())
    assert contents(out) == before

    # and when it succeeds, nothing of the older one is left
    make(meshes, out, unseen=())
    assert "test.h5" in before and not (out / "test.h5").exists()
    make(meshes, tmp_path / "fresh", unseen=())
    assert contents(out) == contents(tmp_path / "fresh")


def test_a_single_file_does_not_rename_the_categories_of_its_neighbors(meshes, tmp_path):
    make(meshes, tmp_path / "all.h5", unseen=None)
    make(meshes, tmp_path / "again.h5", unseen=None)
    before = contents(tmp_path)
    with pytest.raises(ValueError, match="out: .*shape_names.txt gives a.*.h5 other categories"):
        make(meshes / "lamp", tmp_path / "lamps.h5", unseen=None)
    assert contents(tmp_path) == before


def test_meshes_without_subfolders_form_one_category(tmp_path):
    (tmp_path / "things").mkdir()
    for seed in range(3):
        (tmp_path / "things" / f"{seed}.off").write_text(samples.off(knot(seed)))
    assert {item.category for item in folder_items(tmp_path / "things")} == {"things"}


def test_half_of_the_categories_are_unseen_whatever_their_order():
    categories = [f"category {i}" for i in range(9)]
    unseen = choose_unseen(categories)
    assert len(unseen) == 4 and set(unseen) < set(categories)
    assert choose_unseen(categories[::-1] * 2) == unseen


def test_a_build_that_is_impossible_is_refused_with_the_reason(meshes, tmp_path):
    with pytest.raises(ValueError, match="no folder"):
        folder_items(tmp_path / "none")
    with pytest.raises(ValueError, match="no mesh below"):
        folder_items(tmp_path)
    with pytest.raises(ValueError, match="unseen: no mesh is of the categories \\['sofa'\\]"):
        make(meshes, tmp_path / "corpus", unseen=("sofa",))
    items = folder_items(meshes)
    with pytest.raises(ValueError, match="names occur twice"):
        build(items + items[:1], tmp_path / "corpus", (), POINTS, quiet=True)
    broken = [item for item in items if "broken" in item.name]
    with pytest.raises(ValueError, match="none of 1 meshes is fit"):
        build(broken, tmp_path / "corpus", (), POINTS, quiet=True)


def test_builds_are_compared_by_name(meshes, tmp_path):
    items = folder_items(meshes)
    build(items, tmp_path / "there", ("lamp",), POINTS, quiet=True)
    ours = [
        Item(i.name, "chair" if i.name == "table/deep/2.off" else i.category, i.load, i.least_faces)
        for i in items
        if i.name != "lamp/deep/4.off"
    ]
    build(ours, tmp_path / "here", ("table",), POINTS, quiet=True)
    found = compare(tmp_path / "here", tmp_path / "there")
    assert sum(found.common.values()) == 11
    assert found.renamed == {"table/deep/2.off": ["chair", "table"]}
    # Lamps were the test there, and tables are the test here, except one that is now a chair.
    assert len(found.crossed) == 3 + 3
    assert found.only_ours == {"lamp": 1}  # it repeated the lamp that is now missing
    assert found.only_theirs == {
        "lamp": {"lamp/deep/4.off": "not in the sources, or of no category"}
    }
    assert found.distance["most"] == 0 and found.normals["least"] == pytest.approx(1, abs=1e-5)
    assert "12 here, 12 there" in str(found)


def test_comparing_needs_two_corpora(tmp_path):
    with pytest.raises(ValueError, match="no train.h5"):
        compare(tmp_path, tmp_path)
