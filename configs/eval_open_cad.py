"""Evaluation on the open CAD corpus: partial, noisy pairs of the 21 unseen categories.

Every method is given the exact normals; by --config=configs/eval_open_cad.py:estimated every method
is given none, and estimates them from the noisy points. Those are two comparisons.
"""

from ml_collections import ConfigDict


def get_config(normals: str = "exact") -> ConfigDict:
    """Everything that `evaluate.py` reads. The settings were chosen on `val.h5`."""
    config = ConfigDict()
    config.title = "Open CAD shapes, partial pairs of unseen categories"
    config.data = ConfigDict()
    config.data.kind = "corpus"
    config.data.path = "../shared/data/open_cad/test.h5"  # any file in the ModelNet40 layout
    config.data.protocol = "partial"  # or clean, noise, low_overlap, partial_both_ways
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
    config.methods = ConfigDict({"exact": exact, "estimated": estimated}[normals]())
    return config


def exact() -> dict:
    """All methods. Some take no normals of the pair: point-to-point ICP, GICP and KISS-Matcher."""
    return {
        "identity": {"use": "identity"},
        "truth": {"use": "truth"},
        "icp": {"use": "icp", "options": _LOCAL, "threads": 1},
        "icp_plane": {"use": "icp_plane", "options": _LOCAL | {"normal_radius": 0.2}, "threads": 1},
        "gicp": {"use": "gicp", "options": _LOCAL, "threads": 1},
        "gicp_jax": {"use": "gicp_jax", "options": {"cut": 0.1, "normal_radius": 0.2}},
        "kiss_matcher": {
            "use": "kiss_matcher",
            "options": {"voxel": 0.1, "thin": False, "normal_gain": 2.0, "feature_gain": 4.0},
            "threads": 1,
        },
        **by_features(0.3),
        "cfr": network("cfr") | {"modules": True},
        # a second cascade from where the first ended
        "cfr_twice": network("cfr", cascades=2),
        # what a user gets: that, clouds laid about their own centroids, refined, looked at again
        "cfr_align": network("cfr", refine=True, through="align"),
        # trained as long as RPM-Net was (configs/two_hours.py); left out where the file is not
        "cfr_two_hours": network("cfr") | {"weights": "cfr_two_hours"},
        # as published; with the paper's speed-ups, which the others have, it answers the same
        "rpmnet": network("rpmnet", settings={"optimized": False}) | {"modules": True},
        "rpmnet_optim": network("rpmnet") | {"modules": True},
    }


def estimated() -> dict:
    """Those that take normals, called NAME_estimated; RPM-Net once, since both answer the same."""
    known = exact() | by_features(0.45)
    networks = ("cfr", "cfr_twice", "cfr_align", "cfr_two_hours", "rpmnet_optim")
    chosen = ("icp_plane", "gicp_jax", *by_features(0.45), *networks)
    return {
        f"{name}_estimated": known[name] | {"estimated_normals": True, "modules": False}
        for name in chosen
    }


# For clouds of about 700 points in the unit sphere; lengths in its radius. One thread where threads
# would race: for random numbers, or for the order of a sum.
_LOCAL = {"distances": (0.2, 0.1, 0.05), "start": "centroid"}


def by_features(radius: float) -> dict:
    """Methods on FPFH, of neighborhoods that are wider where normals are estimated."""
    features = {"distance": 0.05, "normal_radius": 0.2, "feature_radius": radius}
    return {
        "fgr": {"use": "fgr", "options": features},
        "fgr_icp": {
            "use": "fgr_icp",
            "options": features | {"distances": (0.1, 0.05)},
            "threads": 1,
        },
        "ransac": {"use": "ransac", "options": features, "threads": 1},
    }


def network(use: str, *, refine: bool = False, **options) -> dict:
    """A network on 8 pairs a call."""
    return {"use": use, "options": {"refine": refine} | options, "batch": 8}
