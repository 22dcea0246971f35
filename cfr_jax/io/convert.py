"""Whatever holds points, as a `PointCloud`.

Open3D and trimesh are told by the module of the object's class, so that neither is imported here.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from .cloud import CloudFileError, PointCloud, usable_normals
from .files import read
from .mesh import Mesh


def as_point_cloud(obj: Any, *, name: str, samples: int | None = None, seed: int = 0) -> PointCloud:
    """Points on the host, float64, from what a caller has at hand.

    Args:
        obj: an array (n, 3), or (n, 6) with normals of any length in the last three columns, of
            floats or integers: from numpy, jax, torch (on the CPU), or nested lists; an Open3D
            point cloud or triangle mesh (legacy or tensor); a trimesh PointCloud, Trimesh or
            Scene; a path, which is read; or a PointCloud.
        name: what the caller calls this argument; it opens every error message, and names the
            cloud unless a file does.
        samples: as for `read`: points drawn from a mesh, 10,000 if None, 0 for its vertices.
        seed: of that sampling.

    The points may share memory with `obj`.

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
        return shape if shape is not None else _from_array(_as_array(obj), name)
    except CloudFileError as error:
        raise CloudFileError(f"{name}: {error}") from None
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def _from_library(obj: Any, name: str) -> PointCloud | Mesh | None:
    """A cloud or mesh of Open3D or trimesh; None for everything else."""
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
    return None


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


def _as_array(obj: Any) -> np.ndarray:
    wanted = "wanted an (n, 3) or (n, 6) array, a path, or a cloud of Open3D or trimesh"
    try:
        if not hasattr(obj, "__array__") and hasattr(obj, "__dlpack__"):
            return np.from_dlpack(obj)
        array = np.asarray(obj)
    except Exception as error:  # arrays on a device or with gradients refuse in ways of their own
        raise ValueError(f"got {_kind(obj)}, which is no array ({error}); {wanted}") from None
    if array.dtype.kind not in "fiu":
        raise ValueError(f"got {_kind(obj)} of {array.dtype}; {wanted} of floats or integers")
    return array


def _from_array(array: np.ndarray, name: str) -> PointCloud:
    shape = array.shape
    if array.ndim == 2 and shape[1] in (3, 6):
        return PointCloud(array[:, :3], array[:, 3:] if shape[1] == 6 else None, name)
    hint = ""
    if array.ndim == 2 and shape[0] in (3, 6):
        hint = "; did you mean .T?"
    elif array.ndim == 3 and shape[0] == 1 and shape[2] in (3, 6):
        hint = "; did you mean [0]?"
    raise ValueError(f"got the shape {shape}, wanted (n, 3), or (n, 6) with normals{hint}")


def _kind(obj: Any) -> str:
    return f"a {type(obj).__name__}"
