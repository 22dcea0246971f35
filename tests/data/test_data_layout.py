"""Data is recognized by its layout, and its pairs are found."""

from __future__ import annotations

import h5py
import mesh_samples
import numpy as np
import pytest

from cfr_jax import io
from cfr_jax.batch.jobs import jobs_of
from cfr_jax.data import kinds
from cfr_jax.data.layout import recognize
from cfr_jax.evaluation.datasets import read_pairs

CLOUD = io.PointCloud(np.random.default_rng(0).normal(size=(20, 3)))


def clouds(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        io.write(folder / name, CLOUD)
    return folder


def make(kind, folder):
    """The path of minimal data of one kind."""
    match kind:
        case "pair-list":
            clouds(folder, "a.ply", "b.ply")
            (folder / "pairs.csv").write_text("source,target\n# theirs\n\na.ply,b.ply\n")
            return folder / "pairs.csv"
        case "pair-file":
            with h5py.File(folder / "pairs.h5", "w") as file:
                for name in ("one", "two"):
                    group = file.create_group(name)
                    group["source"], group["target"] = CLOUD.points, CLOUD.points + 1
                    group["transform"] = np.eye(4)
            return folder / "pairs.h5"
        case "corpus" | "modelnet40":
            with h5py.File(folder / "shapes.h5", "w") as file:
                file["data"] = file["normal"] = np.ones((2, 8, 3), np.float32)
                file["label"] = np.zeros(2, np.int64)
            (folder / "shape_names.txt").write_text("chair\n")
            if kind == "modelnet40":
                for half in ("train", "test"):
                    (folder / f"{half}_files.txt").write_text("data/shapes.h5\n")
        case "kitti":
            place = folder / "sequences/00/velodyne"
            place.mkdir(parents=True)
            for frame in range(3):
                np.ones((30, 4), np.float32).tofile(place / f"{frame:06d}.bin")
        case "clouds":
            clouds(folder, "scan1.ply", "scan2.pcd", "scan10.ply")
        case "meshes":
            for name in ("chair.off", "lamp.off"):
                (folder / name).write_text(mesh_samples.off(mesh_samples.knot(0)))
    return folder


@pytest.mark.parametrize("kind", [kind.name for kind in kinds.entries()])
def test_every_kind_is_recognized_and_described(kind, tmp_path):
    found = recognize(make(kind, tmp_path))
    assert found.kind.name == kind and str(tmp_path) in str(found)
    told = {
        "pair-list": "list of 2 lines", "pair-file": "2 pairs", "corpus": "corpus",
        "modelnet40": "ModelNet40", "kitti": "00 (3 scans)", "clouds": "3 point clouds",
        "meshes": "2 meshes",
    }  # fmt: skip
    assert told[kind] in found.found


def test_a_folder_of_ply_is_clouds_or_meshes_as_its_headers_say(tmp_path):
    # given
    face = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    face += "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    face += "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    (tmp_path / "m").mkdir()
    (tmp_path / "m/a.ply").write_text(face)

    # then
    assert recognize(tmp_path / "m").kind.name == "meshes"
    assert recognize(clouds(tmp_path / "c", "a.ply")).kind.name == "clouds"


def test_a_readme_among_meshes_does_not_make_a_folder_of_clouds(tmp_path):
    for name in ("a.stl", "b.obj", "readme.txt"):
        (tmp_path / name).write_text("")

    assert str(recognize(tmp_path)).endswith("2 meshes (.obj, .stl)")
    assert recognize(tmp_path, "clouds").found == "1 point clouds (.txt)"


def test_the_kind_can_be_given_but_must_fit(tmp_path):
    make("clouds", tmp_path)
    assert recognize(tmp_path, "clouds").kind.name == "clouds"
    with pytest.raises(ValueError, match="does not have the layout of kitti: it holds 2 .ply, 1"):
        recognize(tmp_path, "kitti")
    with pytest.raises(ValueError, match="layout: got 'photos', wanted one of pair-list"):
        recognize(tmp_path, "photos")


@pytest.mark.parametrize(
    ("name", "said"),
    [("none", "no file or folder"), ("empty", "holds nothing"), ("photos", "holds 1 .jpg")],
)
def test_unrecognized_data_is_refused_with_what_is_there(name, said, tmp_path):
    for folder in ("empty", "photos"):
        (tmp_path / folder).mkdir()
    (tmp_path / "photos/a.jpg").touch()
    with pytest.raises(ValueError, match=said):
        recognize(tmp_path / name)


def names(jobs):
    return [(job.source, job.target) for job in jobs]


def test_loose_clouds_are_paired_with_the_previous_one_in_natural_order(tmp_path):
    jobs, how = jobs_of(recognize(make("clouds", tmp_path)))
    assert names(jobs) == [("scan2.pcd", "scan1.ply"), ("scan10.ply", "scan2.pcd")]
    assert "before it" in how


def test_names_say_which_cloud_is_source_and_which_is_target(tmp_path):
    clouds(tmp_path, "b_target.ply", "a_source.ply", "b_source.ply", "a_target.ply")
    jobs, how = jobs_of(recognize(tmp_path))
    assert names(jobs) == [("a_source.ply", "a_target.ply"), ("b_source.ply", "b_target.ply")]
    assert "source and target" in how

    folders = clouds(tmp_path / "f", "source/1.ply", "target/1.ply")
    assert names(jobs_of(recognize(folders))[0]) == [("source/1.ply", "target/1.ply")]


def test_one_target_serves_all_others(tmp_path):
    clouds(tmp_path, "a.ply", "b.ply", "model.ply")
    jobs, how = jobs_of(recognize(tmp_path), tmp_path / "model.ply")
    assert names(jobs) == [("a.ply", "model.ply"), ("b.ply", "model.ply")]
    assert "onto model.ply" in how


def test_scans_of_a_sequence_follow_each_other(tmp_path):
    jobs, _ = jobs_of(recognize(make("kitti", tmp_path)))
    frames = [f"sequences/00/velodyne/{frame:06d}.bin" for frame in range(3)]
    assert names(jobs) == [(frames[1], frames[0]), (frames[2], frames[1])]


def test_pairs_of_a_file_are_read_one_by_one(tmp_path):
    jobs, _ = jobs_of(recognize(make("pair-file", tmp_path)))
    assert names(jobs)[1] == ("two/source", "two/target")
    source, target = jobs[1].pair()
    assert np.array_equal(target.points, source.points + 1)


def test_shapes_are_not_pairs(tmp_path):
    with pytest.raises(ValueError, match="not pairs\n.*evaluate.py"):
        jobs_of(recognize(make("corpus", tmp_path)))


@pytest.mark.parametrize("kind", ["pair-file", "clouds", "corpus"])
def test_an_evaluation_recognizes_its_data(kind, tmp_path, capsys):
    # given
    data = {"kind": "auto", "path": str(make(kind, tmp_path))}

    # when, then
    if kind == "pair-file":
        assert len(read_pairs(data, 0, tmp_path)) == 2
        assert "recognized" in capsys.readouterr().out
    else:
        said = {"clouds": "no truth", "corpus": "configs/eval_open_cad.py"}[kind]
        with pytest.raises(ValueError, match=said):
            read_pairs(data, 0, tmp_path)
