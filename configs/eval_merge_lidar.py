"""Merges of a drive: frames of a spinning LiDAR in order."""

from cfr_jax.evaluation.multiway.config import MergeConfig


def get_config() -> MergeConfig:
    """Frames in the layout of KITTI odometry."""
    return MergeConfig(
        title="A drive of a spinning LiDAR",
        data={"kind": "kitti", "path": "data/scans/lidar", "sequence": "00"},
        ordered=True,
        threshold=(1.0, 0.3),
        wrong_edge=(5.0, 1.0),
        unit="m",
    )
