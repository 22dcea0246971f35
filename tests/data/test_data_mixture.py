"""Training data by name: shapes, pairs of scans, drives, single scans, and mixtures."""

import pickle
from pathlib import Path

import h5py
import numpy as np
import pytest
from oracle import pieces
from scipy.spatial.transform import Rotation

from cfr_jax import io
from cfr_jax.data import mixture as mixtures
from cfr_jax.data import scenes
from cfr_jax.data.augmentation.sampling import Sampling
from cfr_jax.data.kinds import clouds, kitti, pair_file, pair_list
from cfr_jax.data.pairs import Pair

FAR = np.array([5e6, -2e6, 100.0])  # map coordinates, meters
NO_CACHE = Path("none is needed")
WHOLE = Sampling(
    points=60, neighbors=6, keep=(1.0, 1.0), noise=(0.0, 0.0), angle=45.0, translation=0.1
)


@pytest.fixture(scope="module")
def surface():
    """300 points of a bumpy ground, 40 m wide, at map coordinates."""
    rng = np.random.default_rng(0)
    flat = rng.uniform(-20, 20, size=(300, 2))
    height = 3 * np.sin(flat[:, 0] / 5) + 2 * np.cos(flat[:, 1] / 4)
    return np.column_stack([flat, height]) + FAR


@pytest.fixture(scope="module")
def motion():
    moved = np.eye(4)
    moved[:3, :3] = Rotation.from_euler("z", 20, degrees=True).as_matrix()
    moved[:3, 3] = FAR - moved[:3, :3] @ FAR + [5, 1, 0.2]
    return moved


@pytest.fixture(scope="module")
def pairs_file(tmp_path_factory, surface, motion):
    """Six pairs that hold the very same points, of frames (0, 1), (2, 3), ..."""
    path = tmp_path_factory.mktemp("pairs") / "pairs.h5"
    with h5py.File(path, "w") as file:
        for i in range(6):
            group = file.create_group(f"pair_{i}")
            group["target"] = surface
            group["source"] = (surface - motion[:3, 3]) @ motion[:3, :3]
            group["transform"] = motion
            group.attrs["source_frame"], group.attrs["target_frame"] = 2 * i, 2 * i + 1
    return path


def test_the_truth_of_a_drawn_pair_aligns_its_scans(pairs_file):
    source = pair_file.train(pairs_file, NO_CACHE)

    for seed in range(3):
        pair = source.draw(1, WHOLE, np.random.default_rng(seed))

        moved = pieces.move(pair["transform"].astype(np.float64), pair["source"])
        # thinned separately, the two share many points, but not all
        gap = np.linalg.norm(moved[:, None] - pair["target"], axis=-1).min(axis=1)
        assert (gap < 1e-4).mean() > 0.1 and np.median(gap) < 0.25
        assert np.linalg.norm(pair["target"], axis=1).max() < 1.6
        assert pair["estimate_normals"] and pair["source"].shape == (60, 3)


def test_a_pair_with_all_its_points_is_aligned_exactly(pairs_file):
    sampling = Sampling(
        points=300, neighbors=6, keep=(1.0, 1.0), noise=(0.0, 0.0), any_orientation=1.0,
        scale=(0.5, 2.0),
    )  # fmt: skip

    pair = pair_file.train(pairs_file, NO_CACHE).draw(0, sampling, np.random.default_rng(0))

    moved = pieces.move(pair["transform"].astype(np.float64), pair["source"])
    gap = np.linalg.norm(moved[:, None] - pair["target"], axis=-1).min(axis=1)
    assert np.quantile(gap, 0.95) < 1e-4  # the crop to 1.0 leaves out the lowest point


def test_the_same_seed_draws_the_same_pair(pairs_file):
    source = pair_file.train(pairs_file, NO_CACHE)

    first, second = (source.draw(2, WHOLE, np.random.default_rng(4)) for _ in range(2))

    for key in first:
        np.testing.assert_array_equal(first[key], second[key])


def test_frames_choose_the_pairs_that_lie_within_them(pairs_file):
    assert pair_file.train(pairs_file, NO_CACHE, frames=(0, 4)).names == ("pair_0", "pair_1")
    assert pair_file.train(pairs_file, NO_CACHE, frames=(3, 9)).names == ("pair_2", "pair_3")
    with pytest.raises(ValueError, match="some within `frames`"):
        pair_file.train(pairs_file, NO_CACHE, frames=(100, 200))


def test_scans_that_are_validated_on_must_not_be_trained_on(pairs_file, tmp_path):
    def opened(frames):
        about = {"kind": "pair-file", "path": str(pairs_file), "frames": frames}
        return mixtures.open_mixture({"room": about}, tmp_path, "data.train")

    mixtures.check_apart(opened((0, 6)), opened((6, 12)))
    with pytest.raises(ValueError, match="2 of its 6 scans are also in data.train"):
        mixtures.check_apart(opened((0, 8)), opened((6, 12)))


def test_a_single_scan_gives_pairs_of_two_views(tmp_path, surface):
    for name in ("a.ply", "b.xyz"):
        io.write(tmp_path / name, io.PointCloud(surface))

    source = clouds.train(tmp_path, NO_CACHE)

    assert source.names == ("a.ply", "b.xyz")
    sampling = Sampling(points=300, neighbors=6, keep=(0.6, 0.7), noise=(0.0, 0.0), translation=0.0)
    pair = source.draw(1, sampling, np.random.default_rng(0))
    moved = pieces.move(pair["transform"].astype(np.float64), pair["source"])
    gap = np.linalg.norm(moved[:, None] - pair["target"], axis=-1).min(axis=1)
    assert 0.3 < (gap < 1e-3).mean() < 0.95  # each is a crop of its own


def test_a_list_of_files_can_be_trained_on_and_needs_truths(tmp_path, surface, motion):
    io.write(tmp_path / "target.ply", io.PointCloud(surface))
    io.write(tmp_path / "source.ply", io.PointCloud((surface - motion[:3, 3]) @ motion[:3, :3]))
    numbers = ",".join(map(repr, motion.ravel().tolist()))
    (tmp_path / "train.csv").write_text(f"source.ply,target.ply,{numbers}\nsource.ply,target.ply\n")

    source = pair_list.train(tmp_path / "train.csv", NO_CACHE)

    pair = source.draw(0, WHOLE, np.random.default_rng(0))
    assert pair["transform"].shape == (4, 4)
    with pytest.raises(ValueError, match="no true transform to learn from"):
        source.draw(1, WHOLE, np.random.default_rng(0))
    with pytest.raises(ValueError, match="does not say from which frames"):
        pair_list.train(tmp_path / "train.csv", NO_CACHE, frames=(0, 5))


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A drive of 12 frames, 2 m apart, along a fence, in KITTI's layout."""
    folder = tmp_path_factory.mktemp("drive")
    rng = np.random.default_rng(0)
    world = rng.uniform((-20, -8, -2), (45, 8, 2), size=(4000, 3))
    world[:, 1] = np.where(rng.random(4000) < 0.5, 8 + world[:, 2] ** 2, world[:, 1])
    frames = folder / "sequences" / "00" / "velodyne"
    frames.mkdir(parents=True)
    poses = []
    for i in range(12):
        seen = (world - [2.0 * i, 0, 0]).astype(np.float32)
        seen = seen[np.linalg.norm(seen, axis=1) < 20]
        np.column_stack([seen, np.zeros(len(seen), np.float32)]).astype(np.float32).tofile(
            frames / f"{i:06d}.bin"
        )
        poses.append(f"1 0 0 {2.0 * i} 0 1 0 0 0 0 1 0")
    (folder / "poses").mkdir()
    (folder / "poses" / "00.txt").write_text("\n".join(poses))
    (folder / "sequences" / "00" / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    return folder


def test_a_drive_gives_pairs_at_several_distances_within_its_frames(drive, tmp_path):
    source = kitti.train(drive, tmp_path, distances=(3.0, 5.0), frames=(0, 7), stride=2)

    assert source.names == ("00/000000-000002", "00/000002-000004", "00/000004-000006",
                            "00/000000-000003", "00/000002-000005")  # fmt: skip
    pair = source.draw(0, WHOLE, np.random.default_rng(0))
    moved = pieces.move(pair["transform"].astype(np.float64), pair["source"])
    # 4 m of 20 m: without the true motion, the two would be a fifth of a radius apart
    everything = source.read(0)
    truth = everything.transform
    np.testing.assert_allclose(truth[:3, 3], [-4, 0, 0], atol=0.1)
    assert np.isfinite(moved).all() and len(list(tmp_path.glob("truths_00_*.npz"))) == 2


def test_validation_draws_two_views_of_a_single_scan_and_keeps_a_recorded_pair(
    pairs_file, tmp_path, surface
):
    io.write(tmp_path / "a.ply", io.PointCloud(surface))
    sampling = Sampling(points=300, neighbors=20, keep=(0.5, 0.6), noise=(0.0, 0.0))

    def shared(**about):
        held = mixtures.open_mixture({"room": about}, tmp_path, "data.validation")
        pairs = mixtures.fixed_pairs(held, 1, sampling, 20, 0.3)
        moved = pieces.move(pairs["transform"][0].astype(np.float64), pairs["source"][0])
        gap = np.linalg.norm(moved[:, None] - pairs["target"][0], axis=-1).min(axis=1)
        return (gap < 1e-3).mean()

    assert shared(kind="clouds", path=str(tmp_path)) < 0.9
    assert shared(kind="pair-file", path=str(pairs_file)) > 0.98


def test_scans_that_cannot_be_read_are_all_named_before_any_training(tmp_path, surface):
    scans, cache = tmp_path / "scans", tmp_path / "cache"
    scans.mkdir(), cache.mkdir()
    io.write(scans / "a.ply", io.PointCloud(surface))
    (scans / "readme.md").write_text("no scan, and none is looked for here")
    (scans / "b.ply").write_bytes((scans / "a.ply").read_bytes()[:-100])
    (scans / "c.txt").write_text("hello\n")

    def opened():
        about = {"kind": "clouds", "path": str(scans)}
        return mixtures.open_mixture({"mine": about}, cache, "data.train")

    with pytest.raises(
        ValueError, match=r"data.train: 2 scans cannot be used.*\n.*b\.ply.*\n.*c\.txt"
    ):
        mixtures.check_readable(opened(), cache, "data.train")
    for name in ("b.ply", "c.txt"):
        (scans / name).unlink()
    mixture = opened()
    mixtures.check_readable(mixture, cache, "data.train")
    reads = mixture.sources[0].read.recent.cache_info().misses
    again = opened()
    mixtures.check_readable(again, cache, "data.train")
    assert reads == 1 and again.sources[0].read.recent.cache_info().misses == 0  # remembered


def test_scans_of_too_few_points_are_named_before_any_training(tmp_path, surface):
    scans = tmp_path / "scans"
    scans.mkdir()
    io.write(scans / "good.ply", io.PointCloud(surface))
    for folder in ("a", "b"):  # two different files with the same name
        (scans / folder).mkdir()
        io.write(scans / folder / "few.ply", io.PointCloud(surface[:3]))
    io.write(scans / "same.ply", io.PointCloud(np.ones((500, 3))))
    about = {"kind": "clouds", "path": str(scans)}
    mixture = mixtures.open_mixture({"mine": about}, tmp_path, "data.train")

    with pytest.raises(
        ValueError,
        match=r"3 scans .*\n.*a/few\.ply has 3 .*\n.*b/few\.ply has 3 .*\n.*same\.ply has 500",
    ):
        mixtures.check_readable(mixture, tmp_path, "data.train")


def test_a_pair_that_cannot_be_drawn_is_named():
    heap = np.zeros((500, 3))
    pair = Pair("heap.ply", heap, heap, transform=np.eye(4))
    source = scenes.SceneSource(("a/heap.ply",), (("a", "a"),), lambda _: pair, "stamp")

    with pytest.raises(ValueError, match="^a/heap.ply: .*do not coincide"):
        source.draw(0, WHOLE, np.random.default_rng(0))


def test_only_some_points_of_a_large_scan_are_kept_in_memory(tmp_path):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(3 * scenes._MOST, 3))
    io.write(tmp_path / "big.ply", io.PointCloud(points, normals=points))

    pair = clouds.train(tmp_path, NO_CACHE).read(0)

    assert pair.source.shape == pair.source_normals.shape == (scenes._MOST, 3)
    directions = pair.source / np.linalg.norm(pair.source, axis=1, keepdims=True)
    alike = np.einsum("ni,ni->n", directions, pair.source_normals)
    assert (alike > 0.99).all()  # each point keeps its own normal
    assert pair.target is pair.source


def test_the_stamp_depends_on_the_data_and_not_on_its_path(tmp_path, surface):
    def stamp(folder, clouds, repeat=1):
        (tmp_path / folder).mkdir()
        for name, cloud in clouds.items():
            io.write(tmp_path / folder / name, io.PointCloud(cloud))
        about = {"kind": "clouds", "path": str(tmp_path / folder), "repeat": repeat}
        return mixtures.open_mixture({"a": about}, tmp_path, "data.train").stamp()

    first = stamp("one", {"a.ply": surface})
    assert first.startswith("1 single scans, ")
    assert stamp("moved", {"a.ply": surface}) == first
    assert stamp("longer", {"a.ply": surface[:200]}) != first
    assert stamp("named", {"b.ply": surface}) != first
    assert stamp("twice", {"a.ply": surface}, repeat=2) != first


def test_lists_that_name_the_same_file_share_a_scan(tmp_path, surface, motion):
    for name in ("a.ply", "b.ply", "c.ply"):
        io.write(tmp_path / name, io.PointCloud(surface))
    numbers = ",".join(map(repr, motion.ravel().tolist()))
    (tmp_path / "train.csv").write_text(f"a.ply,b.ply,{numbers}\n")
    (tmp_path / "val.csv").write_text(f"c.ply,./b.ply,{numbers}\n")

    def opened(name):
        about = {"kind": "pair-list", "path": str(tmp_path / name)}
        return mixtures.open_mixture({"a": about}, tmp_path, "data.train")

    with pytest.raises(ValueError, match="1 of its 2 scans are also in data.train"):
        mixtures.check_apart(opened("train.csv"), opened("val.csv"))
    about = {"kind": "clouds", "path": str(tmp_path)}
    folder = mixtures.open_mixture({"a": about}, tmp_path, "data.validation")
    with pytest.raises(ValueError, match="2 of its 3 scans are also in data.train"):
        mixtures.check_apart(opened("train.csv"), folder)


def test_sources_draw_the_same_in_another_process(pairs_file, drive, tmp_path, surface, motion):
    """Workers that are processes get a source by pickling."""
    io.write(tmp_path / "cloud.ply", io.PointCloud(surface))
    numbers = ",".join(map(repr, motion.ravel().tolist()))
    (tmp_path / "train.csv").write_text(f"cloud.ply,cloud.ply,{numbers}\n")

    for source in (
        pair_file.train(pairs_file, NO_CACHE),
        pair_list.train(tmp_path / "train.csv", NO_CACHE),
        clouds.train(tmp_path, NO_CACHE),
        kitti.train(drive, tmp_path / "cache", distances=(4.0,)),
    ):
        copy = pickle.loads(pickle.dumps(source))
        pair, same = (each.draw(0, WHOLE, np.random.default_rng(0)) for each in (source, copy))
        assert pair.keys() == same.keys()
        for key in pair:
            np.testing.assert_array_equal(pair[key], same[key])


def test_named_sources_are_mixed_as_often_as_configured(pairs_file, tmp_path):
    mixture = mixtures.open_mixture(
        dict(
            room={"kind": "pair-file", "path": str(pairs_file), "repeat": 3},
            out={"kind": "clouds", "path": "nowhere", "repeat": 0},
        ),
        tmp_path,
        "data.train",
    )

    assert len(mixture) == 18 and mixture.locate(7) == (mixture.sources[0], 1)


def test_validation_pairs_are_the_same_every_time(pairs_file, tmp_path):
    about = {"kind": "pair-file", "path": str(pairs_file), "repeat": 2}
    held = mixtures.open_mixture({"room": about}, tmp_path, "data.validation")

    sampling = Sampling(points=40, neighbors=6, keep=(0.5, 0.5))
    first, second = (mixtures.fixed_pairs(held, 10, sampling, 64, 0.3) for _ in range(2))

    assert first["source"].shape == (6, 40, 3) and first["source_neighbors"].shape == (6, 40, 39)
    for key in first:
        np.testing.assert_array_equal(first[key], second[key])


@pytest.mark.parametrize(
    ("about", "wanted"),
    [
        ({"kind": "video", "path": "a"}, "kind: got 'video'"),
        ({"kind": "clouds", "path": "nowhere"}, "path: there is no folder of scans at nowhere"),
        ({"kind": "clouds", "path": "a", "frames": (0, 1)}, "clouds got .*frames.*wanted path"),
        ({"kind": "pair-list"}, "data.train.mine.path: got none, wanted a file or a folder"),
        ({"kind": "clouds", "path": ""}, "data.train.mine.path: got none"),
        ({"kind": "pair-list", "path": "a", "repeat": -1}, "repeat: got -1"),
        ({"kind": "pair-list", "path": "a", "repeat": 0}, "no source"),
    ],
)
def test_a_wrong_entry_of_a_source_is_named(tmp_path, about, wanted):
    with pytest.raises(ValueError, match=wanted):
        mixtures.open_mixture({"mine": about}, tmp_path, "data.train")
