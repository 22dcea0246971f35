"""Ways to find the poses of many scans: ours, a chain of pairs, and Open3D's."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from cfr_jax.runtime.optional import require

_FEATURE_NEIGHBORS, _NORMAL_NEIGHBORS = 100, 30
_TRIES = 100_000  # of RANSAC, for each pair


@dataclass(frozen=True, eq=False)
class Placed:
    """Poses that a way found, and the edges that it kept."""

    placed: Int[np.ndarray, " p"]
    poses: Float[np.ndarray, "p 4 4"]
    """Of those scans, in one frame."""
    edges: tuple[tuple[int, int, Float[np.ndarray, "4 4"]], ...]
    """Source, target, and the motion of the source onto the target."""


def merged(files: Sequence[Path], *, params: dict[str, Any], ordered: bool, seed: int) -> Placed:
    """`cfr_jax.merge`; the largest component counts."""
    from cfr_jax.multiway.merging import merge

    found = merge(
        files, params=params, sequence=ordered, loop_closures=ordered, seed=seed, fused=False
    )
    rows = np.flatnonzero(found.component == 0)
    return Placed(
        found.placed[rows],
        found.poses[rows],
        tuple((edge.source, edge.target, edge.transform) for edge in found.edges if edge.kept),
    )


def chained(files: Sequence[Path], *, params: dict[str, Any], seed: int) -> Placed:
    """Each scan onto the one before it, one motion after the other: errors add up, and after a pair
    without an answer nothing is placed."""
    from cfr_jax.batch.stream import align_many

    pairs = list(zip(files[1:], files[:-1], strict=True))
    poses, edges = [np.eye(4)], []
    for outcome in align_many(pairs, params=params, seed=seed):
        if outcome.alignment is None:
            break
        transform = outcome.alignment.transform
        edges.append((outcome.index + 1, outcome.index, transform))
        poses.append(poses[-1] @ transform)
    return Placed(np.arange(len(poses)), np.stack(poses), tuple(edges))


def by_open3d(files: Sequence[Path], *, ordered: bool, seed: int) -> Placed:
    """Open3D's multiway registration, as its documentation does it: pairs by features and RANSAC
    (in a sequence, from where they lie), refined by point-to-plane ICP; neighbors are sure, other
    pairs are not; then its global optimization, which prunes edges."""
    o3d = require("open3d")
    from cfr_jax.io import read

    reg = o3d.pipelines.registration
    o3d.utility.random.seed(seed)
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(read(f).points)) for f in files]
    spacing = float(
        np.median([np.median(each.compute_nearest_neighbor_distance()) for each in clouds])
    )
    voxel = 2 * spacing
    clouds = [each.voxel_down_sample(voxel) for each in clouds]
    for each in clouds:
        each.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(_NORMAL_NEIGHBORS))
    features = [
        None
        if ordered
        else reg.compute_fpfh_feature(each, o3d.geometry.KDTreeSearchParamKNN(_FEATURE_NEIGHBORS))
        for each in clouds
    ]
    reach = 1.5 * voxel
    graph = reg.PoseGraph()
    graph.nodes.append(reg.PoseGraphNode(np.eye(4)))
    odometry = np.eye(4)
    for source, target in itertools.combinations(range(len(clouds)), 2):
        if ordered and target > source + 2:
            continue
        pair = clouds[source], clouds[target]
        motion = np.eye(4)
        if not ordered:
            motion = _by_features(reg, *pair, features[source], features[target], reach)
        for distance in (5 * reach, reach):
            motion = reg.registration_icp(
                *pair, distance, motion, reg.TransformationEstimationPointToPlane()
            ).transformation
        information = reg.get_information_matrix_from_point_clouds(*pair, reach, motion)
        if target == source + 1:
            odometry = motion @ odometry
            graph.nodes.append(reg.PoseGraphNode(np.linalg.inv(odometry)))
        edge = reg.PoseGraphEdge(source, target, motion, information, target != source + 1)
        graph.edges.append(edge)
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        reg.global_optimization(
            graph,
            reg.GlobalOptimizationLevenbergMarquardt(),
            reg.GlobalOptimizationConvergenceCriteria(),
            reg.GlobalOptimizationOption(
                max_correspondence_distance=reach, edge_prune_threshold=0.25, reference_node=0
            ),
        )
    poses = np.stack([np.array(node.pose) for node in graph.nodes])
    edges = [
        (edge.source_node_id, edge.target_node_id, np.array(edge.transformation))
        for edge in graph.edges
    ]
    return Placed(np.arange(len(poses)), poses, tuple(edges))


def _by_features(
    reg: Any, source: Any, target: Any, source_features: Any, target_features: Any, reach: float
) -> Float[np.ndarray, "4 4"]:
    """The motion that Open3D's RANSAC finds from features."""
    return reg.registration_ransac_based_on_feature_matching(
        source,
        target,
        source_features,
        target_features,
        True,
        reach,
        reg.TransformationEstimationPointToPoint(False),
        3,
        [
            reg.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            reg.CorrespondenceCheckerBasedOnDistance(reach),
        ],
        reg.RANSACConvergenceCriteria(_TRIES, 0.999),
    ).transformation
