"""Evaluation on pairs of depth images: an HDF5 file or a CSV list (`cfr_jax.data.pairs`)."""

from ml_collections import ConfigDict


def get_config() -> ConfigDict:
    """Everything that `evaluate.py` reads. Lengths in meters."""
    config = ConfigDict()
    config.title = "Depth images of a room"
    config.data = ConfigDict()
    config.data.kind = "pairs"
    config.data.path = "../shared/data/scans/rgbd/pairs.h5"  # or a list: source,target,16 numbers
    config.data.frames = ()  # first and stop: pairs of these frames alone, as `scans.test_frames`
    config.limit = 0
    config.seed = 0
    config.weights = "object"
    config.rpmnet_weights = "rpmnet"  # by name or path; RPM-Net is left out where there are none
    config.threads = 2
    config.timeout = 120.0  # seconds a pair
    config.unit = "m"
    config.thresholds = ((1.0, 0.02), (5.0, 0.1), (15.0, 0.3))  # degrees, m
    config.main_threshold = (5.0, 0.1)
    config.limits = (15.0, 0.3)
    config.methods = ConfigDict(methods())
    return config


def methods() -> dict:
    """For rooms thinned to 2.5 cm; such pairs have no normals, so every method estimates them."""
    local = {"distances": (0.2, 0.1, 0.05)}
    features = {"normal_radius": 0.1, "feature_radius": 0.25, "voxel": 0.05}
    prepared = {"through": "preparation", "max_points": 2000}
    network = {"through": "align", "max_points": 2000}
    # One thread where threads would race: for random numbers, or for the order of a sum.
    return {
        "identity": {"use": "identity"},
        "truth": {"use": "truth"},
        # frames of one video: where the camera was is a better start than the centroid
        "icp": {"use": "icp", "options": local | {"start": "identity"}, "threads": 1},
        "icp_plane": {
            "use": "icp_plane",
            "options": local | {"start": "identity", "normal_radius": 0.1},
            "threads": 1,
        },
        "gicp": {"use": "gicp", "options": local | {"start": "identity"}, "threads": 1},
        "gicp_jax": {
            "use": "gicp_jax",
            "options": {"cut": 0.05, "normal_radius": 0.1, "start": "identity"},
        },
        "fgr": {"use": "fgr", "options": features | {"distance": 0.05}},
        "fgr_icp": {
            "use": "fgr_icp",
            "options": features | {"distance": 0.05, "distances": (0.1, 0.05)},
            "threads": 1,
        },
        "ransac": {"use": "ransac", "options": features | {"distance": 0.075}, "threads": 1},
        "kiss_matcher": {"use": "kiss_matcher", "options": {"voxel": 0.05}, "threads": 1},
        "cfr": {"use": "cfr", "options": network | {"refine": False}},
        "cfr_align": {"use": "cfr", "options": network | {"refine": True}},
        # prepared as `align` prepares clouds for our network
        "rpmnet": {
            "use": "rpmnet",
            "options": prepared | {"refine": False, "settings": {"optimized": False}},
        },
        "rpmnet_optim": {"use": "rpmnet", "options": prepared | {"refine": False}},
    }
