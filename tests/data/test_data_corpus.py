import h5py
import numpy as np
import pytest

from cfr_jax.data.corpus import read_corpus


def write(path, shapes=3, points=8, seed=0, categories=("chair", "table"), **replaced):
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(shapes, points, 3))
    held = {
        "data": rng.normal(size=(shapes, points, 3)).astype(np.float32),
        "normal": (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32),
        "label": (np.arange(shapes, dtype=np.uint8) % 2)[:, None],
    } | replaced
    path.parent.mkdir(exist_ok=True)
    with h5py.File(path, "w") as file:
        for key, value in held.items():
            if value is not None:
                file[key] = value
    if categories:
        (path.parent / "shape_names.txt").write_text("\n".join(categories) + "\n")
    return held


def test_a_written_corpus_is_read_back(tmp_path):
    held = write(tmp_path / "a.h5", names=["x", "y", "z"])

    corpus = read_corpus(tmp_path / "a.h5")

    assert len(corpus) == 3
    np.testing.assert_array_equal(corpus.points, held["data"])
    np.testing.assert_allclose(corpus.normals, held["normal"], atol=1e-7)
    np.testing.assert_array_equal(corpus[1][0], held["data"][1])
    assert [corpus.categories[label] for label in corpus.labels] == ["chair", "table", "chair"]
    assert corpus.names == ("x", "y", "z")


def test_int8_normals_come_back_unit_and_within_their_rounding(tmp_path):
    held = write(tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "a") as file:
        del file["normal"]
        file["normal"] = np.round(held["normal"] * 127).astype(np.int8)
        file["normal"].attrs["scale"] = 1 / 127

    corpus = read_corpus(str(tmp_path / "a.h5"))

    np.testing.assert_allclose(np.linalg.norm(corpus.normals, axis=-1), 1, atol=1e-6)
    np.testing.assert_allclose(corpus.normals, held["normal"], atol=1 / 127)


def test_half_precision_points_become_float32(tmp_path):
    write(tmp_path / "a.h5", data=np.full((3, 8, 3), 0.5, np.float16))

    points = read_corpus(tmp_path / "a.h5").points

    assert points.dtype == np.float32
    assert (points == 0.5).all()


def test_a_normal_that_is_zero_stays_zero(tmp_path):
    write(tmp_path / "a.h5", normal=np.zeros((3, 8, 3), np.float32))

    assert (read_corpus(tmp_path / "a.h5").normals == 0).all()


def test_files_with_different_category_lists_are_matched_by_name(tmp_path):
    write(tmp_path / "one" / "a.h5", categories=("chair", "table"), seed=1)
    write(tmp_path / "two" / "b.h5", categories=("table", "lamp"), seed=2)

    corpus = read_corpus([tmp_path / "one" / "a.h5", tmp_path / "two" / "b.h5"])

    found = [corpus.categories[label] for label in corpus.labels]
    assert found == ["chair", "table", "chair", "table", "lamp", "table"]


def test_a_folder_is_read_in_the_order_of_its_file_names(tmp_path):
    second = write(tmp_path / "b.h5", seed=2)
    first = write(tmp_path / "a.h5", seed=1)

    corpus = read_corpus(tmp_path)

    np.testing.assert_array_equal(corpus.points, np.concatenate([first["data"], second["data"]]))
    assert corpus.names[0] == "a.h5:0"


def test_taking_categories_keeps_exactly_their_shapes_in_order(tmp_path):
    held = write(tmp_path / "a.h5")

    chairs = read_corpus(tmp_path / "a.h5").of_categories(["chair"])

    np.testing.assert_array_equal(chairs.points, held["data"][[0, 2]])
    assert chairs.names == ("a.h5:0", "a.h5:2")
    with pytest.raises(ValueError, match="sofa"):
        chairs.of_categories(["sofa"])


@pytest.mark.parametrize(
    ("replaced", "message"),
    [
        ({"normal": None}, r"lacks \['normal'\]"),
        ({"data": np.zeros((3, 8, 2), np.float32)}, r"\(3, 8, 2\), wanted \(S, P, 3\)"),
        ({"normal": np.zeros((3, 7, 3), np.float32)}, "`normal` has shape"),
        ({"label": np.zeros(2, np.uint8)}, "2 labels for 3"),
        ({"label": np.full(3, 5)}, "label 5 has no line"),
        ({"data": np.full((3, 8, 3), np.nan, np.float32)}, "not finite"),
    ],
)
def test_a_malformed_file_is_refused_with_the_reason(tmp_path, replaced, message):
    write(tmp_path / "a.h5", **replaced)

    with pytest.raises(ValueError, match=message):
        read_corpus(tmp_path / "a.h5")


def test_a_path_without_a_corpus_is_answered_with_the_layout(tmp_path):
    (tmp_path / "text.h5").write_text("not HDF5")

    with pytest.raises(ValueError, match="not an HDF5 file.*shape_names.txt"):
        read_corpus(tmp_path / "text.h5")
    with pytest.raises(ValueError, match="no corpus at.*shape_names.txt"):
        read_corpus(tmp_path / "absent.h5")
    with pytest.raises(ValueError, match="wanted the same number in all"):
        write(tmp_path / "a.h5", points=8)
        write(tmp_path / "b.h5", points=9)
        read_corpus([tmp_path / "a.h5", tmp_path / "b.h5"])
