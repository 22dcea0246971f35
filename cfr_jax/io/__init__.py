"""Reading and writing of point clouds, and what users call a point cloud made into one.

Names load on first use: help texts list the formats (`cfr_jax.io.formats`) without numpy.
"""

from typing import TYPE_CHECKING

__all__ = ["CloudFileError", "PointCloud", "as_point_cloud", "read", "write"]

if TYPE_CHECKING:
    from cfr_jax.io.cloud import CloudFileError, PointCloud
    from cfr_jax.io.coercion import as_point_cloud
    from cfr_jax.io.files import read, write
else:
    from cfr_jax.runtime.lazy import loader

    _HOMES = {
        "CloudFileError": "cloud",
        "PointCloud": "cloud",
        "as_point_cloud": "coercion",
        "read": "files",
        "write": "files",
    }

    __getattr__ = loader(__name__, _HOMES)
