"""Clouds as binary PCD."""

from __future__ import annotations

from typing import BinaryIO

import numpy as np

from cfr_jax.io.cloud import CloudFileError, PointCloud
from cfr_jax.io.formats.pcd.reading import FORMAT
from cfr_jax.io.table import Table, deforms, rounding, without_faces

_TYPES = {"f": "F", "i": "I", "u": "U"}
# What PCD does not know is written as a type that holds the same numbers.
_WIDER = {"f2": "f4", "b1": "u1"}
_NORMALS = ("normal_x", "normal_y", "normal_z")


def save(stream: BinaryIO, cloud: PointCloud) -> list[str]:
    """Binary, with every field in its type; points and normals in float32.

    The format knows doubles, too, but Open3D and PCL read coordinates in them as zeros without a
    word: so only what was double in a PCD before stays so. Raises CloudFileError for a cloud that
    float32 would deform.
    """
    table, notes = without_faces(cloud, FORMAT)
    fields: list[tuple[str, np.ndarray]] = []
    lost = []
    for k, (name, values) in enumerate(zip(table.names, table.values, strict=True)):
        kind = values.dtype.kind + str(values.dtype.itemsize)
        values = values.astype(_WIDER[kind]) if kind in _WIDER else values
        if values.dtype.kind not in _TYPES or values.dtype.itemsize > 8:
            lost.append(name)
        elif k in table.roles.points:
            fields += _axes(table, table.roles.points, k, "xyz", values)
        elif k in table.roles.normals:
            fields += _axes(table, table.roles.normals, k, _NORMALS, values)
        else:
            fields.append(("_".join(name.split()) or f"column_{k + 1}", values))
    if lost:
        notes.append(f"left out {', '.join(lost)}: PCD holds numbers")
    _check_rounding(cloud, table)
    _write(stream, fields, table)
    return notes


def _axes(
    table: Table, roles: tuple[int, ...], k: int, usual: object, values: np.ndarray
) -> list[tuple[str, np.ndarray]]:
    """The coordinates of a column, under the names that PCD has for them."""
    if table.format != FORMAT:
        values = values.astype(np.float32)
    if len(roles) == 1:
        return [(usual[axis], values[:, axis]) for axis in range(3)]  # type: ignore[index]
    axis = roles.index(k)
    name = table.names[k] if table.format == FORMAT else usual[axis]  # type: ignore[index]
    return [(name, values)]


def _check_rounding(cloud: PointCloud, table: Table) -> None:
    single = np.dtype(np.float32)
    if table.format == FORMAT or not deforms(cloud.points, single):
        return
    extent = float(np.linalg.norm(np.ptp(cloud.points, axis=0)))
    moved = rounding(cloud.points, single) * extent
    raise CloudFileError(
        f"PCD holds float32, which here moves points by {moved:.1g} in a cloud "
        f"{extent:.3g} across; wanted .ply, .npy, .npz or .xyz, or points nearer the origin"
    )


def _write(stream: BinaryIO, fields: list[tuple[str, np.ndarray]], table: Table) -> None:
    count = len(fields[0][1])
    repeats = [1 if values.ndim == 1 else values.shape[1] for _, values in fields]
    width, height, viewpoint = str(count), "1", ["0", "0", "0", "1", "0", "0", "0"]
    if table.format == FORMAT and table.rest is not None:
        entries = table.rest.entries
        grid = entries.get("WIDTH", [""])[0], entries.get("HEIGHT", ["1"])[0]
        if all(n.isdecimal() for n in grid) and int(grid[0]) * int(grid[1]) == count:
            width, height = grid
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(name for name, _ in fields),
        "SIZE " + " ".join(str(values.dtype.itemsize) for _, values in fields),
        "TYPE " + " ".join(_TYPES[values.dtype.kind] for _, values in fields),
        "COUNT " + " ".join(map(str, repeats)),
        f"WIDTH {width}",
        f"HEIGHT {height}",
        "VIEWPOINT " + " ".join(viewpoint),
        f"POINTS {count}",
        "DATA binary",
        "",
    ]
    stream.write("\n".join(lines).encode("latin1", "replace"))
    layout = [
        (f"{k}", values.dtype.newbyteorder("<"), values.shape[1:])
        for k, (_, values) in enumerate(fields)
    ]
    rows = np.empty(count, layout)
    for k, (_, values) in enumerate(fields):
        rows[f"{k}"] = values
    stream.write(rows.tobytes())
