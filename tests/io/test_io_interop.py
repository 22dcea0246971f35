"""Clouds of other libraries, by the libraries themselves: torch, pandas, and ROS's message."""

from __future__ import annotations

import array
import importlib.util
import os
import subprocess
import sys
from types import SimpleNamespace

import cli_samples
import numpy as np
import pytest
from io_samples import normals, points

from cfr_jax.io import PointCloud, as_point_cloud

# Number of the type in sensor_msgs/PointField.
FLOAT32, FLOAT64, UINT16, UINT8 = 7, 8, 4, 2
NUMPY = {FLOAT32: "f4", FLOAT64: "f8", UINT16: "u2", UINT8: "u1"}


def message(columns, *, height=1, bigendian=False, padding=5, row_padding=0, kind=bytes):
    """A PointCloud2 as a driver would fill it: fields at odd offsets, rows padded."""
    order = ">" if bigendian else "<"
    fields, at = [], 3
    for name, (datatype, _) in columns.items():
        fields.append(SimpleNamespace(name=name, offset=at, datatype=datatype, count=1))
        at += np.dtype(NUMPY[datatype]).itemsize
    layout = np.dtype(
        {
            "names": [field.name for field in fields],
            "formats": [order + NUMPY[field.datatype] for field in fields],
            "offsets": [field.offset for field in fields],
            "itemsize": at + padding,
        }
    )
    count = len(next(iter(columns.values()))[1])
    cells = np.zeros(count, layout)
    for name, (_, values) in columns.items():
        cells[name] = values
    rows = cells.reshape(height, -1).view(np.uint8).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, row_padding)), constant_values=77)
    return SimpleNamespace(
        height=height, width=count // height, fields=fields, is_bigendian=bigendian,
        point_step=layout.itemsize, row_step=rows.shape[1], data=kind(rows.tobytes()),
        is_dense=False,
    )  # fmt: skip


def xyz(values, datatype=FLOAT32):
    return {axis: (datatype, values[:, k]) for k, axis in enumerate("xyz")}


KINDS = {
    "bytes": bytes,
    "array of ROS 2": lambda octets: array.array("B", octets),
    "list of numbers": list,
    "numpy": lambda octets: np.frombuffer(octets, np.uint8),
    "memoryview": memoryview,
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("bigendian", [False, True])
def test_a_ros_message_is_read_as_its_fields_say(kind, bigendian):
    given = message(
        {"intensity": (UINT8, np.arange(60)), **xyz(points()), "ring": (UINT16, np.arange(60))},
        height=4,
        row_padding=7,
        bigendian=bigendian,
        kind=KINDS[kind],
    )
    cloud = as_point_cloud(given, name="scan")
    np.testing.assert_array_equal(cloud.points, points().astype("f4"))
    assert cloud.normals is None and cloud.name == "scan" and cloud.left_out == 0


def test_the_normals_of_a_ros_message_are_kept():
    directions = {f"normal_{axis}": (FLOAT64, normals()[:, k]) for k, axis in enumerate("xyz")}
    cloud = as_point_cloud(message({**xyz(points(), FLOAT64), **directions}), name="scan")
    np.testing.assert_array_equal(cloud.points, points())
    np.testing.assert_allclose(cloud.normals, normals(), atol=1e-12)


def test_cells_of_a_ros_message_without_a_point_are_left_out_and_counted():
    holes = points()
    holes[[0, 7, 59]] = np.nan
    cloud = as_point_cloud(message(xyz(holes), height=6), name="scan")
    np.testing.assert_array_equal(cloud.points, np.delete(points(), [0, 7, 59], 0).astype("f4"))
    assert cloud.left_out == 3


def broken(**changes):
    given = message(xyz(points()))
    for name, value in changes.items():
        setattr(given, name, value)
    return given


def strange_field(**changes):
    given = message(xyz(points()))
    for name, value in changes.items():
        setattr(given.fields[1], name, value)
    return given


BROKEN = {
    "too little data": (lambda: broken(data=b"abc"), "3 bytes do not hold 1 rows of 60 points"),
    "a row step too small": (lambda: broken(row_step=4), "do not hold"),
    "no z": (lambda: broken(fields=message(xyz(points())).fields[:2]), "has no z among x, y"),
    "no fields": (lambda: broken(fields=[]), "has no x and no y and no z among no columns"),
    "an unknown type": (lambda: strange_field(datatype=99), "'y' has the type 99"),
    "a list in a field": (lambda: strange_field(count=3), "the count 3"),
    "a field outside": (lambda: strange_field(offset=400), "do not fit into a point_step"),
    "no points": (lambda: message(xyz(points()[:0])), "holds no points"),
    "only holes": (lambda: message(xyz(np.full((9, 3), np.nan))), "all 9 points are NaN"),
    "infinity": (
        lambda: message(xyz(points() + [np.inf, 0, 0])),
        "all 60 points are NaN or infinite",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_ros_message_that_holds_no_cloud_is_refused_by_name(case):
    make, told = BROKEN[case]
    with pytest.raises(ValueError, match=f"^source: .*{told}"):
        as_point_cloud(make(), name="source")


def test_structured_arrays_are_taken_in_any_shape():
    layout = [("ring", "u2"), ("x", "f4"), ("y", "f4"), ("z", "f8")]
    cells = np.zeros((6, 10), layout)
    for k, axis in enumerate("xyz"):
        cells[axis] = points()[:, k].reshape(6, 10)
    cells["x"][0, 0] = np.nan
    cloud = as_point_cloud(cells, name="source")
    np.testing.assert_allclose(cloud.points, points()[1:], rtol=1e-6)
    assert cloud.left_out == 1
    with pytest.raises(ValueError, match=r"^source: has no y and no z among a, x"):
        as_point_cloud(np.zeros(4, [("a", "f4"), ("x", "f4")]), name="source")


def test_pandas_frames_are_taken_by_the_names_of_their_columns_or_by_their_count():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(points(), columns=["X", "Y", "Z"]).assign(label="tree")
    for column, values in zip(("nx", "ny", "nz"), normals().T, strict=True):
        frame[column] = values
    cloud = as_point_cloud(frame.sample(frac=1, random_state=0).sort_index(), name="source")
    np.testing.assert_array_equal(cloud.points, points())
    np.testing.assert_allclose(cloud.normals, normals(), atol=1e-12)
    unnamed = as_point_cloud(pandas.DataFrame(points()), name="source")
    np.testing.assert_array_equal(unnamed.points, points())

    frame.loc[3, "Y"] = None
    with pytest.raises(ValueError, match="^source: point 3 is .*nan"):
        as_point_cloud(frame, name="source")
    with pytest.raises(ValueError, match="^source: a column is of "):
        as_point_cloud(frame.assign(X="left"), name="source")
    with pytest.raises(ValueError, match=r"^source: got the shape \(60, 2\)"):
        as_point_cloud(pandas.DataFrame(points()[:, :2]), name="source")


def test_torch_tensors_share_their_memory_where_they_can():
    torch = pytest.importorskip("torch")
    tensor = torch.from_numpy(points())
    cloud = as_point_cloud(tensor, name="source")
    assert np.shares_memory(cloud.points, tensor.numpy())
    learned = torch.nn.Parameter(tensor.float())
    np.testing.assert_array_equal(
        as_point_cloud(learned, name="source").points, points().astype("f4")
    )
    coarse = as_point_cloud(tensor.bfloat16(), name="source").points
    np.testing.assert_allclose(coarse, points(), rtol=1e-2)


def test_torch_tensors_that_hold_no_cloud_are_refused_by_name():
    torch = pytest.importorskip("torch")
    with pytest.raises(ValueError, match=r"^source: got a tensor which is no array"):
        as_point_cloud(torch.eye(3).to_sparse(), name="source")
    with pytest.raises(ValueError, match=r"^source: got a Tensor of bool"):
        as_point_cloud(torch.zeros(4, 3, dtype=torch.bool), name="source")
    with pytest.raises(ValueError, match=r"^source: got the shape \(1, 5, 3\).*\[0\]"):
        as_point_cloud(torch.zeros(1, 5, 3), name="source")


def test_an_answer_goes_to_open3d_as_its_own_kind_of_result():
    # given, in a process of its own, since Open3D brings its own threads and warnings
    if importlib.util.find_spec("open3d") is None:
        pytest.skip("open3d is optional")
    code = """
import numpy as np, open3d as o3d, cli_samples
from cfr_jax.io import PointCloud
cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cli_samples.points(50, 0)))
found = cli_samples.alignment(PointCloud(cloud.points), PointCloud(cloud.points))
result = found.to_open3d()
assert isinstance(result, o3d.pipelines.registration.RegistrationResult)
assert (result.fitness, result.inlier_rmse) == (found.fitness, found.inlier_rmse)
moved = np.asarray(cloud.points) @ found.transform[:3, :3].T + found.transform[:3, 3]
assert np.allclose(np.asarray(cloud.transform(result.transformation).points), moved)
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}

    # when
    child = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment
    )

    # then
    assert child.returncode == 0, child.stderr


def test_without_open3d_the_message_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    monkeypatch.setitem(sys.modules, "open3d.pipelines", None)
    monkeypatch.setitem(sys.modules, "open3d.pipelines.registration", None)
    cloud = PointCloud(points())
    with pytest.raises(ModuleNotFoundError, match=r"cfr_jax\[baselines\]"):
        cli_samples.alignment(cloud, cloud).to_open3d()
