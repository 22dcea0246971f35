"""Clouds whose columns have names: ROS messages, structured arrays, data frames."""

from __future__ import annotations

from typing import Any

import numpy as np

from cfr_jax.io.cloud import PointCloud, usable_normals
from cfr_jax.io.naming import are_names
from cfr_jax.io.table import cloud_of_filled, table_of

# sensor_msgs/PointField: the numbers of the types.
_ROS_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_READ = ("x", "y", "z", "normal_x", "normal_y", "normal_z", "nx", "ny", "nz")


def is_point_cloud2(obj: Any) -> bool:
    """Whether `obj` has the members of a ROS sensor_msgs/PointCloud2, of ROS 1 or 2."""
    members = ("fields", "point_step", "row_step", "width", "height", "data", "is_bigendian")
    return all(hasattr(obj, member) for member in members)


def from_point_cloud2(message: Any, name: str) -> PointCloud:
    """The points of a message, with normal_x, normal_y, normal_z if it has them.

    Cells without a point, which drivers mark by NaN, are left out and counted in `left_out`. Raises
    ValueError for fields or sizes that do not fit the data.
    """
    order = ">" if message.is_bigendian else "<"
    names, formats, offsets = [], [], []
    for field in message.fields:
        if field.name in _READ:
            if field.datatype not in _ROS_TYPES or field.count not in (0, 1):
                raise ValueError(
                    f"field {field.name!r} has the type {field.datatype} and the count "
                    f"{field.count}, wanted one number"
                )
            names.append(field.name)
            formats.append(order + _ROS_TYPES[field.datatype])
            offsets.append(field.offset)
    width, height, step = (int(message.width), int(message.height), int(message.point_step))
    row_step = int(message.row_step) or width * step
    data = message.data
    if not isinstance(data, (bytes, bytearray, memoryview, np.ndarray)):
        data = bytes(data)  # a list of numbers
    octets = np.frombuffer(data, np.uint8)
    if row_step < width * step or len(octets) < height * row_step:
        raise ValueError(
            f"{len(octets)} bytes do not hold {height} rows of {width} points of {step} bytes"
        )
    try:
        layout = np.dtype(
            {"names": names, "formats": formats, "offsets": offsets, "itemsize": step}
        )
    except ValueError as error:
        raise ValueError(f"fields do not fit into a point_step of {step}: {error}") from None
    rows = octets[: height * row_step].reshape(height, row_step)[:, : width * step]
    return from_structured(np.ascontiguousarray(rows).view(layout), name)


def from_structured(array: np.ndarray, name: str) -> PointCloud:
    """The fields x, y, z of a structured array of any shape, and the normals if they are there.

    Rows with NaN in x, y or z carry no point, as ROS marks them: they are left out and counted in
    `left_out`.
    """
    flat = array.reshape(-1)
    names = list(array.dtype.names or ())
    table = table_of(names, [flat[column] for column in names])
    return cloud_of_filled(table.points(), table.normals(), name)


def from_data_frame(frame: Any, name: str) -> PointCloud | None:
    """The columns x, y, z of a pandas or polars frame, and the normals if they are there; None for
    a frame without such columns."""
    names = [str(column) for column in frame.columns]
    if not are_names(names):
        return None
    values = [frame[column].to_numpy() for column in frame.columns]
    table = table_of(names, values)
    for column in (*table.roles.points, *table.roles.normals):
        _check_numbers(values[column])
    normals = table.normals()
    return PointCloud(table.points(), None if normals is None else usable_normals(normals), name)


def _check_numbers(values: np.ndarray) -> None:
    if values.dtype.kind not in "fiu":
        raise ValueError(f"a column is of {values.dtype}, wanted floats or integers")
