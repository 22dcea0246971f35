"""Reading and writing of point clouds, and what users call a point cloud made into one."""

from cfr_jax.io.cloud import CloudFileError, PointCloud
from cfr_jax.io.coercion import as_point_cloud
from cfr_jax.io.files import read, write

__all__ = ["CloudFileError", "PointCloud", "as_point_cloud", "read", "write"]
