import h5py
import numpy as np
import pytest

from cfr_jax.data.modelnet import read_modelnet40

CATEGORIES = [f"kind_{letter}{number}" for letter in "abcd" for number in range(10)]


@pytest.fixture
def folder(tmp_path):
    """The unpacked folder: two files per half, each with one shape per category, points = label."""
    rng = np.random.default_rng(0)
    listed = rng.permutation(40)  # alphabetical order, not the line number, decides what is seen
    (tmp_path / "shape_names.txt").write_text("".join(f"{CATEGORIES[i]}\n" for i in listed))
    for half, offset in (("train", 0), ("test", 1000)):
        lines = []
        for part in (1, 0):
            name = f"ply_data_{half}{part}.h5"
            lines.append(f"data/modelnet40_ply_hdf5_2048/{name}\n")
            labels = rng.permutation(40)
            with h5py.File(tmp_path / name, "w") as file:
                of_label = (labels + offset + 100 * part)[:, None, None]
                file["data"] = np.broadcast_to(of_label, (40, 5, 3)).astype(np.float32)
                file["normal"] = np.ones((40, 5, 3), np.float32)
                file["label"] = labels[:, None].astype(np.uint8)
        (tmp_path / f"{half}_files.txt").write_text("".join(lines))
    return tmp_path


@pytest.mark.parametrize(
    ("split", "offset", "wanted"),
    [
        ("train", 0, CATEGORIES[:20]),
        ("val", 1000, CATEGORIES[:20]),
        ("test", 1000, CATEGORIES[20:]),
    ],
)
def test_a_split_holds_its_half_of_the_categories_from_its_files(folder, split, offset, wanted):
    corpus = read_modelnet40(folder, split)

    found = [corpus.categories[label] for label in corpus.labels]
    assert sorted(found) == sorted(2 * wanted)
    first_point = corpus.points[:, 0, 0].astype(int) - offset
    np.testing.assert_array_equal(first_point % 100, corpus.labels)


def test_shapes_stay_in_the_order_of_the_list_and_of_each_file(folder):
    with (
        h5py.File(folder / "ply_data_test1.h5") as first,
        h5py.File(folder / "ply_data_test0.h5") as second,
    ):
        order = np.concatenate([first["data"][:, 0, 0], second["data"][:, 0, 0]])

    found = read_modelnet40(folder, "test").points[:, 0, 0]

    np.testing.assert_array_equal(found, order[np.isin(order, found)])


@pytest.mark.parametrize("lost", ["shape_names.txt", "test_files.txt", "ply_data_test0.h5"])
def test_what_is_missing_is_named_with_where_to_get_it(folder, lost):
    (folder / lost).unlink()

    with pytest.raises(ValueError, match=rf"{lost}.*https://.*zip"):
        read_modelnet40(folder, "test")


def test_another_corpus_is_not_taken_for_modelnet(folder):
    (folder / "shape_names.txt").write_text("".join(f"{i}\n" for i in range(45)))

    with pytest.raises(ValueError, match="lists 45 categories, wanted 40"):
        read_modelnet40(folder, "val")
