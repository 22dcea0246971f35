"""Evaluation on the open CAD corpus: partial, noisy pairs of the 21 unseen categories.

Every method gets the exact normals. With --config=configs/eval_open_cad.py:estimated, methods get
none and estimate them from the noisy points; this is a separate comparison.
"""

from dataclasses import replace
from typing import Any

from cfr_jax.evaluation.config import EvaluationConfig, MethodEntry


def get_config(normals: str = "exact") -> EvaluationConfig:
    """The settings were chosen on `val.h5`."""
    return EvaluationConfig(
        title="Open CAD shapes, partial pairs of unseen categories",
        data={
            "kind": "corpus",
            # from `cfr data open-cad --out data/open_cad`, or any file in the ModelNet40 layout
            "path": "data/open_cad/test.h5",
            "protocol": "partial",  # or clean, noise, overlap_1 to overlap_9, ...
        },
        methods={"exact": exact, "estimated": estimated}[normals](),
        limit=300,
    )


def exact() -> dict[str, MethodEntry]:
    """All methods. Point-to-point ICP, GICP and KISS-Matcher do not use the normals of a pair."""
    kiss = {"voxel": 0.1, "thin": False, "normal_gain": 2.0, "feature_gain": 4.0}
    return {
        "identity": MethodEntry("identity"),
        "truth": MethodEntry("truth"),
        "icp": MethodEntry("icp", _LOCAL, threads=1),
        "icp_plane": MethodEntry("icp_plane", _LOCAL | {"normal_radius": 0.2}, threads=1),
        "gicp": MethodEntry("gicp", _LOCAL, threads=1),
        "gicp_jax": MethodEntry("gicp_jax", {"cut": 0.1, "normal_radius": 0.2}),
        "kiss_matcher": MethodEntry("kiss_matcher", kiss, threads=1),
        **by_features(0.3),
        "cfr": network("cfr", modules=True),
        # a second cascade that starts where the first one ended
        "cfr_twice": network("cfr", {"cascades": 2}),
        # what a user gets: also two cascades, clouds moved to their centroids, refinement, and a
        # second look
        "cfr_align": network("cfr", {"refine": True, "through": "align"}),
        # trained as long as RPM-Net (configs/two_hours.py); left out if there is no such file
        "cfr_two_hours": network("cfr", weights="cfr_two_hours"),
        # as published; rpmnet_optim has the paper's speed-ups, and gives the same answers
        "rpmnet": network("rpmnet", {"settings": {"optimized": False}}, modules=True),
        "rpmnet_optim": network("rpmnet", modules=True),
        **peers(),
    }


def estimated() -> dict[str, MethodEntry]:
    """The methods that use normals, as NAME_estimated; of both RPM-Nets, which answer the same,
    only one."""
    known = exact() | by_features(0.45)
    networks = ("cfr", "cfr_twice", "cfr_align", "cfr_two_hours", "rpmnet_optim")
    chosen = ("icp_plane", "gicp_jax", *by_features(0.45), *networks)
    return {
        f"{name}_estimated": replace(known[name], estimated_normals=True, modules=False)
        for name in chosen
    }


# For clouds of about 700 points in the unit sphere; lengths are in its radius. Methods have one
# thread where several would race, for random numbers or for the order of a sum.
_LOCAL = {"distances": (0.2, 0.1, 0.05), "start": "centroid"}


def peers() -> dict[str, MethodEntry]:
    """The other learned methods of the paper's table, which take no normals. Weights are those that
    `dcp.py`, `fmr.py` and `rgm.py` train, or those of `cfr convert`; left out where there are none.
    """
    return {
        "dcp": network("dcp", weights="dcp", modules=True),
        "fmr": network("fmr", weights="fmr", modules=True),
        # of reduced width (`rgm.py`), and four times through the network all the same
        "rgm": network("rgm", weights="rgm", modules=True),
    }


def by_features(radius: float) -> dict[str, MethodEntry]:
    """Methods that match FPFH features over `radius`, which is wider for estimated normals."""
    features = {"distance": 0.05, "normal_radius": 0.2, "feature_radius": radius}
    return {
        "fgr": MethodEntry("fgr", features),
        "fgr_icp": MethodEntry("fgr_icp", features | {"distances": (0.1, 0.05)}, threads=1),
        "ransac": MethodEntry("ransac", features, threads=1),
    }


def network(use: str, options: dict[str, Any] | None = None, **fields: Any) -> MethodEntry:
    """A network that solves 8 pairs per call, without refinement unless `options` say so."""
    return MethodEntry(use, {"refine": False} | (options or {}), batch=8, **fields)
