"""Evaluation on LiDAR scans in the layout of KITTI odometry, moved at random."""

from ml_collections import ConfigDict


def get_config() -> ConfigDict:
    """Everything that `evaluate.py` reads. Lengths in meters."""
    config = ConfigDict()
    config.title = "LiDAR scans, frames about 10 m apart"
    config.data = ConfigDict()
    config.data.kind = "kitti"
    config.data.path = "../shared/data/scans/lidar"  # or the folder of KITTI odometry
    config.data.sequences = ("00",)  # published numbers: 08, 09, 10
    config.data.distance = 10.0  # between the frames of a pair
    config.data.stride = 2  # frames from pair to pair; 0: the next pair starts after the last, as
    # published, which leaves few pairs of a short sequence
    config.data.frames = ()  # first and stop: pairs of these frames alone, as `scans.test_frames`
    config.data.points = 4000
    config.data.angle = 45.0  # degrees, per Euler angle
    config.data.translation = 15.0
    config.limit = 60
    config.seed = 0
    config.weights = "object"
    config.rpmnet_weights = "rpmnet"  # by name or path; RPM-Net is left out where there are none
    config.threads = 2
    config.timeout = 120.0  # seconds a pair
    config.unit = "m"
    config.thresholds = ((1.0, 0.1), (1.0, 0.5), (5.0, 2.0))  # degrees, m
    config.main_threshold = (5.0, 2.0)
    config.limits = (15.0, 5.0)
    config.methods = ConfigDict(methods())
    return config


def methods() -> dict:
    """For scans thinned to 0.3 m, whose normals come from 3 m around, as published."""
    local = {"distances": (4.0, 2.0, 1.0), "start": "centroid"}
    features = {"normal_radius": 3.0, "feature_radius": 5.0, "voxel": 0.3}
    prepared = {"through": "preparation", "max_points": 4000}
    network = {"through": "align", "max_points": 4000}
    # One thread where threads would race: for random numbers, or for the order of a sum.
    return {
        "identity": {"use": "identity"},
        "truth": {"use": "truth"},
        "icp": {"use": "icp", "options": local, "threads": 1},
        "icp_plane": {
            "use": "icp_plane",
            "options": local | {"normal_radius": 3.0},
            "threads": 1,
        },
        "gicp": {"use": "gicp", "options": local, "threads": 1},
        "gicp_jax": {"use": "gicp_jax", "options": {"cut": 1.0, "normal_radius": 3.0}},
        "fgr": {"use": "fgr", "options": features | {"distance": 0.6}},
        "fgr_icp": {
            "use": "fgr_icp",
            "options": features | {"distance": 0.6, "distances": (2.0, 1.0)},
            "threads": 1,
        },
        "ransac": {"use": "ransac", "options": features | {"distance": 0.6}, "threads": 1},
        "kiss_matcher": {"use": "kiss_matcher", "options": {"voxel": 1.0}, "threads": 1},
        "cfr": {"use": "cfr", "options": network | {"refine": False}},
        "cfr_align": {"use": "cfr", "options": network | {"refine": True}},
        "cfr_estimated": {
            "use": "cfr",
            "options": network | {"refine": False},
            "estimated_normals": True,
        },
        # prepared as `align` prepares clouds for our network
        "rpmnet": {
            "use": "rpmnet",
            "options": prepared | {"refine": False, "settings": {"optimized": False}},
        },
        "rpmnet_optim": {"use": "rpmnet", "options": prepared | {"refine": False}},
        "rpmnet_optim_estimated": {
            "use": "rpmnet",
            "options": prepared | {"refine": False},
            "estimated_normals": True,
        },
    }
