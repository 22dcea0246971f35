"""Evaluation on pairs of depth images: an HDF5 file or a CSV list (`cfr_jax.data.pairs`)."""

from cfr_jax.evaluation.config import EvaluationConfig, MethodEntry


def get_config() -> EvaluationConfig:
    """All lengths are in meters."""
    return EvaluationConfig(
        title="Depth images of a room",
        data={
            "kind": "auto",
            "path": "data/scans/rgbd/pairs.h5",  # or a list: source,target,16 numbers
            # first frame and stop, to use only these; `scans.py` leaves (400, 500) for a test
            "frames": (),
        },
        methods=methods(),
        timeout=120.0,
        unit="m",
        thresholds=((1.0, 0.02), (5.0, 0.1), (15.0, 0.3)),
    )


def methods() -> dict[str, MethodEntry]:
    """Methods for rooms thinned to 2.5 cm; such pairs have no normals, so every method estimates
    them."""
    # for frames of one video, no motion is a better start than matching the centroids
    local = {"distances": (0.2, 0.1, 0.05), "start": "identity"}
    ours = {"cut": 0.05, "normal_radius": 0.1, "start": "identity"}
    features = {"normal_radius": 0.1, "feature_radius": 0.25, "voxel": 0.05, "distance": 0.05}
    # clouds are prepared for RPM-Net in the way `align` prepares them for our network
    prepared = {"through": "preparation", "max_points": 2000, "refine": False}
    network = {"through": "align", "max_points": 2000}
    # One thread where several would race, for random numbers or for the order of a sum.
    return {
        "identity": MethodEntry("identity"),
        "truth": MethodEntry("truth"),
        "icp": MethodEntry("icp", local, threads=1),
        "icp_plane": MethodEntry("icp_plane", local | {"normal_radius": 0.1}, threads=1),
        "gicp": MethodEntry("gicp", local, threads=1),
        "gicp_jax": MethodEntry("gicp_jax", ours),
        "fgr": MethodEntry("fgr", features),
        "fgr_icp": MethodEntry("fgr_icp", features | {"distances": (0.1, 0.05)}, threads=1),
        "ransac": MethodEntry("ransac", features | {"distance": 0.075}, threads=1),
        "kiss_matcher": MethodEntry("kiss_matcher", {"voxel": 0.05}, threads=1),
        "cfr": MethodEntry("cfr", network | {"refine": False}),
        "cfr_align": MethodEntry("cfr", {"through": "align", "refine": True}),
        "rpmnet": MethodEntry("rpmnet", prepared | {"settings": {"optimized": False}}),
        "rpmnet_optim": MethodEntry("rpmnet", prepared),
        # of clouds whose pairs of points are too many to be stored, DCP and RGM say so
        **{name: MethodEntry(name, prepared, weights=name) for name in ("dcp", "fmr", "rgm")},
    }
