"""Evaluation on randomly moved LiDAR scans in the layout of KITTI odometry."""

from cfr_jax.evaluation.config import EvaluationConfig, MethodEntry


def get_config() -> EvaluationConfig:
    """All lengths are in meters."""
    return EvaluationConfig(
        title="LiDAR scans, frames about 10 m apart",
        data={
            "kind": "kitti",
            "path": "data/scans/lidar",  # or the folder of KITTI odometry
            "sequences": ("00",),  # published results use 08, 09, 10
            "distance": 10.0,  # between the two frames of a pair
            # frames from one pair to the next; 0: the next pair starts where the last one ended, as
            # published, which leaves few pairs in a short sequence
            "stride": 2,
            # first frame and stop, to use only these; `scans.py` leaves (52, 69) for a test
            "frames": (),
            "points": 4000,
            "angle": 45.0,  # degrees, per Euler angle
            "translation": 15.0,
        },
        methods=methods(),
        limit=60,
        timeout=120.0,
        unit="m",
        thresholds=((1.0, 0.1), (1.0, 0.5), (5.0, 2.0)),
        main_threshold=(5.0, 2.0),
        limits=(15.0, 5.0),
    )


def methods() -> dict[str, MethodEntry]:
    """Methods for scans thinned to 0.3 m, with normals from a radius of 3 m, as published."""
    local = {"distances": (4.0, 2.0, 1.0), "start": "centroid"}
    features = {"normal_radius": 3.0, "feature_radius": 5.0, "voxel": 0.3, "distance": 0.6}
    # clouds are prepared for RPM-Net in the way `align` prepares them for our network
    prepared = {"through": "preparation", "max_points": 4000, "refine": False}
    network = {"through": "align", "max_points": 4000, "refine": False}
    # One thread where several would race, for random numbers or for the order of a sum.
    return {
        "identity": MethodEntry("identity"),
        "truth": MethodEntry("truth"),
        "icp": MethodEntry("icp", local, threads=1),
        "icp_plane": MethodEntry("icp_plane", local | {"normal_radius": 3.0}, threads=1),
        "gicp": MethodEntry("gicp", local, threads=1),
        "gicp_jax": MethodEntry("gicp_jax", {"cut": 1.0, "normal_radius": 3.0}),
        "fgr": MethodEntry("fgr", features),
        "fgr_icp": MethodEntry("fgr_icp", features | {"distances": (2.0, 1.0)}, threads=1),
        "ransac": MethodEntry("ransac", features, threads=1),
        "kiss_matcher": MethodEntry("kiss_matcher", {"voxel": 1.0}, threads=1),
        "cfr": MethodEntry("cfr", network),
        "cfr_align": MethodEntry("cfr", {"through": "align", "refine": True}),
        "cfr_estimated": MethodEntry("cfr", network, estimated_normals=True),
        "rpmnet": MethodEntry("rpmnet", prepared | {"settings": {"optimized": False}}),
        "rpmnet_optim": MethodEntry("rpmnet", prepared),
        "rpmnet_optim_estimated": MethodEntry("rpmnet", prepared, estimated_normals=True),
        # of clouds whose pairs of points are too many to be stored, DCP and RGM say so
        **{name: MethodEntry(name, prepared, weights=name) for name in ("dcp", "fmr", "rgm")},
    }
