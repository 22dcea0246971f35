"""A cloud with columns of many types in every format that is written, and how it is moved."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pandas
import plyfile
from io_samples import COUNT, normals, points
from kind_samples import npy

from cfr_jax.io import PointCloud

TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # exact in every type
SHIFT = np.array([0.5, -1.0, 2.0])
WRITABLE = (".ply", ".pcd", ".xyz", ".csv", ".npy", ".npz")
rng = np.random.default_rng(5)
TYPES = {
    "red": rng.integers(0, 256, COUNT).astype("u1"),
    "intensity": rng.uniform(0, 1, COUNT).astype("f4"),
    "label": rng.integers(-100, 100, COUNT).astype("i2"),
    "ring": rng.integers(0, 60_000, COUNT).astype("u2"),
    "object": rng.integers(-(2**31), 2**31, COUNT).astype("i4"),
    "time": 1.6e9 + rng.uniform(0, 1, COUNT),
}


def rows(kind: str = "f4") -> np.ndarray:
    """A table whose columns are in no usual order, as a structured array."""
    fields = [("time", "f8"), ("label", "i2"), ("z", kind), ("x", kind), ("red", "u1")]
    fields += [("nx", "f4"), ("y", kind), ("ny", "f4"), ("nz", "f4"), ("ring", "u2")]
    fields += [("intensity", "f4"), ("object", "i4")]
    made = np.empty(COUNT, fields)
    for k, axis in enumerate("xyz"):
        made[axis], made["n" + axis] = points()[:, k], normals()[:, k]
    for name, values in TYPES.items():
        made[name] = values
    return made


def moved(cloud: PointCloud, turn=TURN, shift=SHIFT) -> PointCloud:
    """As `cfr register` moves a source: its points and normals, and its table with them."""
    table = cloud.table
    directions = table.normals()
    table = table.moved(
        table.points() @ turn.T + shift, None if directions is None else directions @ turn.T
    )
    return dataclasses.replace(cloud, points=cloud.points @ turn.T + shift, table=table)


def column(name: str, table: np.ndarray, turned: bool = True) -> np.ndarray:
    """What a column of `table` has to be after the motion."""
    axes = {"x": (0, False), "y": (1, False), "z": (2, False)}
    axes |= {"nx": (0, True), "ny": (1, True), "nz": (2, True)}
    if name not in axes or not turned:
        return table[name]
    axis, direction = axes[name]
    labels = ("nx", "ny", "nz") if direction else ("x", "y", "z")
    stacked = np.stack([table[label].astype(float) for label in labels], axis=1) @ TURN.T
    return (stacked if direction else stacked + SHIFT)[:, axis].astype(table[name].dtype)


def put(folder: Path, form: str, table: np.ndarray) -> Path:
    path = folder / f"source{form}"
    if form == ".ply":
        plyfile.PlyData([plyfile.PlyElement.describe(table, "vertex")]).write(path)
    elif form == ".npy":
        path.write_bytes(npy(table))
    elif form == ".npz":
        np.savez(path, **{name: table[name] for name in table.dtype.names})
    elif form in (".csv", ".xyz"):
        frame = pandas.DataFrame(table)
        frame.to_csv(path, index=False, sep="," if form == ".csv" else " ")
    else:
        head = "VERSION .7\nFIELDS {}\nSIZE {}\nTYPE {}\nCOUNT{}\n".format(
            " ".join(table.dtype.names),
            " ".join(str(table.dtype[name].itemsize) for name in table.dtype.names),
            " ".join(table.dtype[name].kind.upper() for name in table.dtype.names),
            " 1" * len(table.dtype.names),
        )
        head += f"WIDTH 10\nHEIGHT {COUNT // 10}\nPOINTS {COUNT}\nDATA binary\n"
        path.write_bytes(head.encode() + table.tobytes())
    return path


def columns_in(path: Path) -> dict[str, np.ndarray]:
    """The columns of a file by name in order, by other libraries than ours where there is one."""
    if path.suffix == ".ply":
        vertex = plyfile.PlyData.read(path)["vertex"]
        return {prop.name: np.asarray(vertex[prop.name]) for prop in vertex.properties}
    if path.suffix == ".npy":
        table = np.load(path)
        return {name: table[name] for name in table.dtype.names}
    if path.suffix == ".npz":
        with np.load(path) as held:
            return dict(held)
    if path.suffix == ".pcd":
        head, _, body = path.read_bytes().partition(b"DATA binary\n")
        said = dict(line.split(" ", 1) for line in head.decode().splitlines()[1:])
        kinds = zip(said["TYPE"].lower().split(), said["SIZE"].split(), strict=True)
        fields = zip(said["FIELDS"].split(), (f"<{a}{b}" for a, b in kinds), strict=True)
        table = np.frombuffer(body, list(fields))
        return {name: table[name] for name in table.dtype.names}
    separator = "," if path.suffix == ".csv" else " "
    frame = pandas.read_csv(path, sep=separator, float_precision=None)
    frame.columns = [*frame.columns[1:], None] if frame.columns[0] == "#" else frame.columns
    return {name: frame[name].to_numpy() for name in frame.columns if name}
