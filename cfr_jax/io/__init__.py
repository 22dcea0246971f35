"""Reading and writing of point clouds, and what users call a point cloud made into one."""

from .cloud import CloudFileError, PointCloud
from .convert import as_point_cloud
from .files import read, write

__all__ = ["CloudFileError", "PointCloud", "as_point_cloud", "read", "write"]
