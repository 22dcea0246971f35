"""Other methods on the same pair: installed ones, and the programs of the papers' authors.

The authors' programs are not part of this project. `--authors FOLDER` names a checkout, once for
each program. These public layouts are known:

- CFR, github.com/yoichiro0406/cascading_feature_extraction: `src/models/cfenet.py`,
- RPM-Net, github.com/yewzijian/RPMNet: `src/models/rpmnet.py`.

The models are imported, get fresh parameters (which do not affect the time), and are called as in
their own `eval.py`. Both have packages of the same names, so each runs in its own process, with as
many threads as this one, and sends its times back. They need torch and the packages they import.
"""

from __future__ import annotations

import argparse
import importlib
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

RUNS = 9
_KNOWN = {"cfenet": "CFR, the authors' PyTorch", "rpmnet": "RPM-Net, its authors' PyTorch"}


def installed() -> Iterator[tuple[str, dict]]:
    """The `evaluation.baselines` that are installed, by name, with options for the unit sphere."""
    from cfr_jax.runtime.optional import require

    local = {"distances": (0.2, 0.1, 0.05), "start": "centroid"}
    features = {"distance": 0.05, "normal_radius": 0.2, "feature_radius": 0.3}
    wanted = {
        "icp_plane": ("open3d", local | {"normal_radius": 0.2}),
        "fgr": ("open3d", features),
        "gicp": ("small_gicp", local),
        "kiss_matcher": ("kiss_matcher", {"voxel": 0.1, "thin": False}),
    }
    for name, (package, options) in wanted.items():
        try:
            require(package)
        except (ImportError, ValueError) as error:
            print(f"  {name}: left out, {str(error).splitlines()[0]}", file=sys.stderr)
            continue
        yield name, options


def authors(
    checkout: Path, source: np.ndarray, target: np.ndarray, folder: Path, device: str = "cpu"
) -> dict:
    """Times of the program in `checkout` on these pairs (b, n, 6), points with normals.

    `device` is "cpu" or "cuda". The result has the program's name, and either `milliseconds` of
    each run or `failure`, the reason why there are none.
    """
    path = folder / "pair.npz"
    np.savez(path, source=source, target=target)
    child = subprocess.run(
        [sys.executable, __file__, str(checkout), str(path), device],
        capture_output=True,
        text=True,
        timeout=600,
    )
    if child.returncode:
        lines = child.stderr.strip().splitlines() or ["no message"]
        return {"name": checkout.name, "failure": lines[-1]}
    return json.loads(child.stdout.splitlines()[-1])


def _run(checkout: Path, pair: Path, device: str) -> dict:
    """Runs in the child: imports, builds and times the model."""
    import torch

    root = checkout / "src" if (checkout / "src").is_dir() else checkout
    sys.path.insert(0, str(root))
    kind = next((k for k in _KNOWN if (root / "models" / f"{k}.py").is_file()), None)
    if kind is None:
        raise SystemExit(f"{root} has neither models/cfenet.py nor models/rpmnet.py")
    arguments = argparse.Namespace(
        radius=0.3,
        num_neighbors=64,
        feat_dim=96,
        features=["ppf", "dxyz", "xyz"],
        num_sk_iter=5,
        num_reg_iter=5,
        num_train_reg_iter=2,
        no_slack=False,
        loss_type="mae",
        wt_inliers=1e-2,
        sk_type="sum_approx",
        via_cpu=False,
        ppf_type="inner_prod",
        knn="k_select",
    )
    torch.manual_seed(0)
    model = importlib.import_module(f"models.{kind}").get_model(arguments).eval().to(device)
    with np.load(pair) as clouds:
        data = {
            name: torch.from_numpy(clouds[key]).to(device)
            for name, key in (("points_src", "source"), ("points_ref", "target"))
        }
    times = []
    with torch.no_grad():
        for _ in range(RUNS + 2):  # two to warm up
            began = time.perf_counter()
            model(data, 5)
            if device == "cuda":
                torch.cuda.synchronize()
            times.append(1e3 * (time.perf_counter() - began))
    return {"name": _KNOWN[kind], "milliseconds": times[2:], "threads": torch.get_num_threads()}


if __name__ == "__main__":
    print(json.dumps(_run(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3])))
