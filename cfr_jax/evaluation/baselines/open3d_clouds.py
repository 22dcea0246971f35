"""Converts clouds to Open3D, with the normals and features that classical methods need."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from cfr_jax.data.scans import estimate_normals
from cfr_jax.io import PointCloud
from cfr_jax.runtime.optional import require


def open3d_cloud(
    cloud: PointCloud, normal_radius: float | None = None, voxel: float | None = None
) -> Any:
    """An `open3d.geometry.PointCloud`, thinned to `voxel` if that is given.

    With a `normal_radius` the result has normals. If the cloud has none, they are estimated before
    the thinning, from at most 30 points within the radius. They face the centroid, so that two
    views agree on the sign.
    """
    o3d = require("open3d")
    made = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points))
    if normal_radius is not None:
        normals = cloud.normals
        if normals is None:
            center = cloud.points.mean(axis=0)
            normals = estimate_normals(cloud.points, normal_radius, viewpoint=tuple(center))
        made.normals = o3d.utility.Vector3dVector(normals)
    if voxel is None:
        return made
    thinned = made.voxel_down_sample(voxel)
    if thinned.has_normals():
        thinned.normalize_normals()
    return thinned


@dataclass(frozen=True, kw_only=True)
class FeatureOptions:
    """What FGR and RANSAC take alike; lengths are in the unit of the clouds."""

    distance: float
    """Up to which a correspondence counts."""
    normal_radius: float
    feature_radius: float
    """Of the neighborhoods that a feature describes."""
    voxel: float | None = None
    """The clouds are thinned to this first, if it is given."""
    seed: int = 0

    def described(self, cloud: PointCloud) -> tuple[Any, Any]:
        """A cloud and its fast point feature histograms (FPFH; Rusu et al., 2009)."""
        o3d = require("open3d")
        made = open3d_cloud(cloud, self.normal_radius, self.voxel)
        around = o3d.geometry.KDTreeSearchParamHybrid(radius=self.feature_radius, max_nn=100)
        return made, o3d.pipelines.registration.compute_fpfh_feature(made, around)
