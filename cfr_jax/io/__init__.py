"""Reading and writing of point clouds, and whatever users have as a point cloud made into one.

Names load on first use: help texts list the formats (`cfr_jax.io.formats`) without numpy.
"""

from typing import TYPE_CHECKING

__all__ = ["CloudFileError", "CloudWarning", "PointCloud", "as_point_cloud", "read", "write"]

if TYPE_CHECKING:
    from cfr_jax.io.cloud import CloudFileError, CloudWarning, PointCloud
    from cfr_jax.io.coercion import as_point_cloud
    from cfr_jax.io.files import read, write
else:
    from cfr_jax.runtime.lazy import loader

    _HOMES = {
        "CloudFileError": "cloud",
        "CloudWarning": "cloud",
        "PointCloud": "cloud",
        "as_point_cloud": "coercion",
        "read": "files",
        "write": "files",
    }

    __getattr__ = loader(__name__, _HOMES)
