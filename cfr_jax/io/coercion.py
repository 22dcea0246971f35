"""Whatever holds points, as a `PointCloud`.

Other libraries' objects are told by the module of their class, and ROS messages by their members,
so that none of them is imported here.
"""

from __future__ import annotations

import os
import warnings
from typing import Any

import numpy as np

from cfr_jax.io.cloud import (
    CloudFileError,
    CloudWarning,
    PointCloud,
    as_float64,
    usable_normals,
)
from cfr_jax.io.columns import from_data_frame, from_point_cloud2, from_structured, is_point_cloud2
from cfr_jax.io.files import read
from cfr_jax.io.mesh import Mesh
from cfr_jax.io.unnamed import along_axes, are_unit


def as_point_cloud(obj: Any, *, name: str, samples: int | None = None, seed: int = 0) -> PointCloud:
    """Points on the host, float64, from what a caller has at hand.

    Args:
        obj: an array (n, 3), or (n, 6) with unit normals in the last three columns, of floats or
            integers: from numpy, jax, torch (on any device, with or without gradients), whatever
            speaks DLPack or the array protocol, or nested lists; a structured array with the fields
            x, y, z, and perhaps normal_x … or nx …; a pandas or polars frame with such columns, or
            with 3 or 6 of them; a ROS PointCloud2 message, whose cells without a point (NaN) are
            left out; an Open3D point cloud or triangle mesh (legacy or tensor); a trimesh
            PointCloud, Trimesh or Scene; a path, which is read; or a PointCloud. If the last three
            of six columns are not unit vectors, they are left out with a `CloudWarning`.
        name: what the caller calls this argument; every error message begins with it, and it names
            the cloud unless a file does.
        samples: as for `read`: points drawn from a mesh, 10,000 if None, 0 for its vertices.
        seed: of that sampling.

    Nothing is copied that need not be: float64 rows in host memory share it with `obj`.

    Raises:
        ValueError: `obj` holds no point cloud; says what came and what was wanted.
        CloudFileError: `obj` is a path, and `read` cannot read it.
    """
    if isinstance(obj, PointCloud):
        return obj
    try:
        if isinstance(obj, (str, os.PathLike)):
            return read(obj, samples=samples, seed=seed)
        shape = _from_library(obj, name)
        if isinstance(shape, Mesh):
            return shape.points(samples, seed)
        if shape is not None:
            return shape
        array = _as_array(obj)
        if array.dtype.names:
            return from_structured(array, name)
        return _from_array(array, name)
    except CloudFileError as error:
        raise CloudFileError(f"{name}: {error}") from None
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def _from_library(obj: Any, name: str) -> PointCloud | Mesh | None:
    """A cloud or mesh of a library, a frame, a ROS message; None for everything else."""
    # Derived classes live in the user's module; the library's own is then among the bases.
    for kind in type(obj).__mro__:
        match kind.__module__.partition(".")[0], kind.__name__:
            case "open3d", "PointCloud":
                return _from_open3d(obj, name)
            case "open3d", "TriangleMesh":
                return _from_open3d_mesh(obj, name)
            case "trimesh", "PointCloud":
                return PointCloud(_numbers(obj.vertices), None, name)
            case "trimesh", "Scene":
                return _from_library(obj.to_mesh(), name)
            case "trimesh", "Trimesh":
                return Mesh(_numbers(obj.vertices), _numbers(obj.faces).astype(np.int64), name)
            case "torch", "Tensor":
                return _from_array(_checked(obj, _from_torch(obj)), name)
            case "pandas" | "polars", "DataFrame":
                return from_data_frame(obj, name)
    return from_point_cloud2(obj, name) if is_point_cloud2(obj) else None


def _from_torch(tensor: Any) -> np.ndarray:
    try:
        tensor = tensor.detach().cpu()
        return (tensor.float() if str(tensor.dtype) == "torch.bfloat16" else tensor).numpy()
    except (TypeError, RuntimeError) as error:  # sparse, quantized
        raise ValueError(f"got a tensor which is no array ({error}); {_WANTED}") from None


def _from_open3d(cloud: Any, name: str) -> PointCloud:
    if hasattr(cloud, "point"):  # the tensor kind keeps its attributes in a map, on a device
        if "positions" not in cloud.point:
            raise ValueError("holds no points, wanted at least one")
        points = cloud.point["positions"].cpu().numpy()
        normals = cloud.point["normals"].cpu().numpy() if "normals" in cloud.point else None
    else:
        points = np.asarray(cloud.points)
        normals = np.asarray(cloud.normals) if len(cloud.normals) else None
    return PointCloud(points, None if normals is None else usable_normals(normals), name)


def _from_open3d_mesh(mesh: Any, name: str) -> Mesh:
    if hasattr(mesh, "vertex"):
        if "positions" not in mesh.vertex or "indices" not in mesh.triangle:
            raise ValueError("is a mesh without faces, wanted at least one")
        vertices = mesh.vertex["positions"].cpu().numpy()
        triangles = mesh.triangle["indices"].cpu().numpy()
    else:
        vertices, triangles = np.asarray(mesh.vertices), np.asarray(mesh.triangles)
    return Mesh(vertices.reshape(-1, 3), triangles.astype(np.int64).reshape(-1, 3), name)


def _numbers(values: Any) -> np.ndarray:
    return np.asarray(values).view(np.ndarray)  # trimesh hands out arrays that track changes


_WANTED = (
    "wanted an (n, 3) or (n, 6) array, a path, or a cloud of Open3D, trimesh, torch, pandas or ROS"
)


def _as_array(obj: Any) -> np.ndarray:
    try:
        if not hasattr(obj, "__array__") and hasattr(obj, "__dlpack__"):
            array = np.from_dlpack(obj)
        else:
            array = np.asarray(obj)
    except Exception as error:  # arrays on a device or with gradients refuse in ways of their own
        raise ValueError(f"got {_kind(obj)}, which is no array ({error}); {_WANTED}") from None
    return array if array.dtype.names else _checked(obj, array)


def _checked(obj: Any, array: np.ndarray) -> np.ndarray:
    if array.dtype.name == "bfloat16":  # a type of its own to numpy
        return array.astype(np.float32)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"got {_kind(obj)} of {array.dtype}; {_WANTED} of floats or integers")
    return array


def _from_array(array: np.ndarray, name: str) -> PointCloud:
    shape = array.shape
    if array.ndim == 2 and shape[1] == 3:
        return PointCloud(array, None, name)
    if array.ndim == 2 and shape[1] == 6:
        points, last = array[:, :3], array[:, 3:]
        if _are_normals(last):
            return PointCloud(points, last, name)
        warnings.warn(CloudWarning(name, _NO_NORMALS), stacklevel=4)
        return PointCloud(points, None, name)
    hint = ""
    if array.ndim == 2 and shape[0] in (3, 6):
        hint = "; did you mean .T?"
    elif array.ndim == 3 and shape[0] == 1 and shape[2] in (3, 6):
        hint = "; did you mean [0]?"
    raise ValueError(f"got the shape {shape}, wanted (n, 3), or (n, 6) with normals{hint}")


_NO_NORMALS = (
    "the last three of six columns are no unit normals (colors?) and were left out; "
    "PointCloud(points, normals) takes any directions"
)


def _are_normals(columns: np.ndarray) -> bool:
    parts = [as_float64(columns[:, k]) for k in range(3)]
    return are_unit(parts) and not along_axes(parts)


def _kind(obj: Any) -> str:
    return f"a {type(obj).__name__}"
