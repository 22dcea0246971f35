"""Evaluation on the open CAD corpus: partial, noisy pairs of the 21 unseen categories."""

from ml_collections import ConfigDict


def get_config() -> ConfigDict:
    """Everything that `evaluate.py` reads. The settings were chosen on `val.h5`."""
    config = ConfigDict()
    config.title = "Open CAD shapes, partial pairs of unseen categories"
    config.data = ConfigDict()
    config.data.kind = "corpus"
    config.data.path = "../shared/data/open_cad/test.h5"  # any file in the ModelNet40 layout
    config.data.protocol = "partial"  # or clean, noise, low_overlap
    config.limit = 300  # pairs; 0 for all
    config.seed = 0
    config.weights = "object"
    config.rpmnet_weights = "rpmnet"  # by name or path; RPM-Net is left out where there are none
    config.threads = 2
    config.timeout = 60.0  # seconds a pair
    config.unit = ""  # the unit sphere
    config.thresholds = ((1.0, 0.02), (1.0, 0.1), (5.0, 0.1))  # degrees, length
    config.main_threshold = (5.0, 0.1)  # of the plots
    config.limits = (15.0, 0.3)  # where the axes of the recall plots end
    config.methods = ConfigDict(methods())
    return config


def methods() -> dict:
    """For clouds of about 700 points in the unit sphere; lengths in its radius.

    A peer that takes normals is given the same exact ones as the network, and once more none.
    """
    local = {"distances": (0.2, 0.1, 0.05), "start": "centroid"}
    features = {"distance": 0.05, "normal_radius": 0.2}
    # One thread where threads would race: for random numbers, or for the order of a sum.
    return {
        "identity": {"use": "identity"},
        "truth": {"use": "truth"},
        "icp": {"use": "icp", "options": local, "threads": 1},
        "icp_plane": {
            "use": "icp_plane",
            "options": local | {"normal_radius": 0.2},
            "threads": 1,
        },
        "gicp": {"use": "gicp", "options": local, "threads": 1},
        "gicp_jax": {"use": "gicp_jax", "options": {"cut": 0.1, "normal_radius": 0.2}},
        "fgr": {"use": "fgr", "options": features | {"feature_radius": 0.3}},
        "fgr_icp": {
            "use": "fgr_icp",
            "options": features | {"feature_radius": 0.3, "distances": (0.1, 0.05)},
            "threads": 1,
        },
        "ransac": {"use": "ransac", "options": features | {"feature_radius": 0.3}, "threads": 1},
        "fgr_estimated": {
            "use": "fgr",
            "options": features | {"feature_radius": 0.45},
            "estimated_normals": True,
        },
        "fgr_icp_estimated": {
            "use": "fgr_icp",
            "options": features | {"feature_radius": 0.45, "distances": (0.1, 0.05)},
            "threads": 1,
            "estimated_normals": True,
        },
        "ransac_estimated": {
            "use": "ransac",
            "options": features | {"feature_radius": 0.45},
            "estimated_normals": True,
            "threads": 1,
        },
        "kiss_matcher": {
            "use": "kiss_matcher",
            "options": {"voxel": 0.1, "thin": False, "normal_gain": 2.0, "feature_gain": 4.0},
        },
        "cfr": network("cfr") | {"modules": True},
        "cfr_refined": network("cfr", refine=True),
        "cfr_estimated": network("cfr", estimated=True),
        "cfr_estimated_refined": network("cfr", refine=True, estimated=True),
        # as published; with the paper's speed-ups, which the others have, it answers the same
        "rpmnet": network("rpmnet", settings={"optimized": False}) | {"modules": True},
        "rpmnet_optim": network("rpmnet") | {"modules": True},
        "rpmnet_optim_refined": network("rpmnet", refine=True),
        "rpmnet_optim_estimated": network("rpmnet", estimated=True),
        "rpmnet_optim_estimated_refined": network("rpmnet", refine=True, estimated=True),
        # trained as long as RPM-Net was (configs/two_hours.py); left out where the file is not
        "cfr_two_hours": network("cfr") | {"weights": "cfr_two_hours"},
        "cfr_two_hours_estimated": network("cfr", estimated=True) | {"weights": "cfr_two_hours"},
    }


def network(use: str, *, refine: bool = False, estimated: bool = False, **options) -> dict:
    """A network on 8 pairs a call."""
    return {
        "use": use,
        "options": {"refine": refine} | options,
        "batch": 8,
        "estimated_normals": estimated,
    }
