import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cfr_jax.data.pairs import CsvPairs, Hdf5Pairs

TRUTH = np.eye(4)
TRUTH[:3, :3] = Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix()
TRUTH[:3, 3] = [1, 2, 3]
WRITTEN = ",".join(map(str, TRUTH.ravel()))


@pytest.fixture
def folder(tmp_path):
    """A folder with two clouds as text files."""
    rng = np.random.default_rng(0)
    (tmp_path / "clouds").mkdir()
    for name in ("a", "b"):
        np.savetxt(tmp_path / "clouds" / f"{name}.xyz", rng.normal(size=(20, 3)))
    return tmp_path


def test_a_list_gives_its_pairs_with_and_without_truth(folder):
    listed = folder / "pairs.csv"
    listed.write_text(
        "source,target,t00\n"
        "# two pairs\n"
        f"clouds/a.xyz, clouds/b.xyz,{WRITTEN}\n"
        "\n"
        f"{folder}/clouds/b.xyz,clouds/a.xyz\n"
    )

    pairs = CsvPairs(listed)

    assert len(pairs) == 2
    assert pairs.names[0] == "clouds/a.xyz -> clouds/b.xyz"
    first, second = pairs
    np.testing.assert_allclose(first.source, np.loadtxt(folder / "clouds" / "a.xyz"))
    np.testing.assert_allclose(first.target, np.loadtxt(folder / "clouds" / "b.xyz"))
    np.testing.assert_array_equal(first.transform, TRUTH)
    np.testing.assert_array_equal(second.source, first.target)
    assert second.transform is None and second.source_normals is None


def test_a_list_is_checked_before_any_cloud_is_read(folder):
    listed = folder / "pairs.csv"
    listed.write_text("absent.ply,missing.ply\n")

    pairs = CsvPairs(str(listed))

    assert pairs.names == ("absent.ply -> missing.ply",)
    with pytest.raises((ValueError, OSError), match="absent.ply"):
        pairs[0]
    with pytest.raises(IndexError, match="index: got 1, wanted one of 1 pairs"):
        pairs[1]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("a.ply", "line 2: wanted `source,target`"),
        ("a.ply,b.ply,1,0,0", "line 2: got 3 numbers after the two files, wanted 16"),
        ("a.ply,b.ply" + ",x" * 16, "line 2: could not convert.*wanted 16 numbers"),
        ("a.ply,b.ply" + ",2" * 16, "line 2: transform: got .*not rigid"),
        ("a.ply,b.ply" + ",nan" * 16, "line 2: transform: got .*finite"),
    ],
)
def test_a_bad_line_is_named_by_its_number(folder, line, message):
    listed = folder / "pairs.csv"
    listed.write_text(f"source,target\n{line}\n")

    with pytest.raises(ValueError, match=message):
        CsvPairs(listed)


def test_a_reflection_is_not_taken_for_a_motion(folder):
    mirror = np.diag([1.0, 1.0, -1.0, 1.0])
    (folder / "pairs.csv").write_text("a.ply,b.ply," + ",".join(map(str, mirror.ravel())))

    with pytest.raises(ValueError, match="R is a reflection"):
        CsvPairs(folder / "pairs.csv")


def test_groups_of_an_hdf5_file_are_its_pairs_in_the_order_of_their_names(tmp_path):
    rng = np.random.default_rng(0)
    clouds = rng.normal(size=(3, 9, 3)).astype(np.float32)
    with h5py.File(tmp_path / "pairs.h5", "w") as file:
        file["pair_1/source"], file["pair_1/target"] = clouds[0], clouds[1, :5]
        file["pair_0/source"], file["pair_0/target"] = clouds[1], clouds[2]
        file["pair_0/source_normals"] = clouds[0]
        file["pair_0/transform"], file["pair_0/overlap"] = TRUTH, 0.4

    pairs = Hdf5Pairs(tmp_path / "pairs.h5")

    assert pairs.names == ("pair_0", "pair_1")
    full, bare = pairs
    np.testing.assert_array_equal(full.source, clouds[1])
    np.testing.assert_array_equal(full.source_normals, clouds[0])
    np.testing.assert_array_equal(full.transform, TRUTH)
    assert full.overlap == 0.4 and full.target_normals is None
    np.testing.assert_array_equal(bare.target, clouds[1, :5])
    assert bare.transform is None and bare.overlap is None


@pytest.mark.parametrize(
    ("held", "message"),
    [
        ({"source": np.ones((4, 3))}, r"lacks \['target'\]"),
        ({"source": np.ones((4, 2)), "target": np.ones((4, 3))}, r"source is .*\(N, 3\)"),
        ({"source": np.ones((4, 3)), "target": np.full((4, 3), np.inf)}, "target holds numbers"),
        (
            {
                "source": np.ones((4, 3)),
                "target": np.ones((4, 3)),
                "source_normals": np.ones((3, 3)),
            },
            "source_normals is",
        ),
        (
            {"source": np.ones((4, 3)), "target": np.ones((4, 3)), "transform": 2 * np.eye(4)},
            "not rigid",
        ),
    ],
)
def test_a_bad_group_is_named(tmp_path, held, message):
    with h5py.File(tmp_path / "pairs.h5", "w") as file:
        for key, value in held.items():
            file[f"only/{key}"] = value

    with pytest.raises(ValueError, match=f"only.*{message}"):
        Hdf5Pairs(tmp_path / "pairs.h5")[0]


def test_a_file_that_is_not_a_list_of_pairs_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no file of pairs at"):
        CsvPairs(tmp_path / "absent.csv")
    (tmp_path / "empty.csv").write_text("source,target\n")
    with pytest.raises(ValueError, match="lists no pairs"):
        CsvPairs(tmp_path / "empty.csv")
    (tmp_path / "noise.csv").write_bytes(bytes(range(255, 0, -1)))
    with pytest.raises(ValueError, match="is not a CSV list"):
        CsvPairs(tmp_path / "noise.csv")
    with h5py.File(tmp_path / "flat.h5", "w") as file:
        file["data"] = np.ones(3)
    with pytest.raises(ValueError, match="has no groups"):
        Hdf5Pairs(tmp_path / "flat.h5")
