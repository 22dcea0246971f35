"""Writes the validation pairs of the weights `scan` as one HDF5 file of pairs.

    python -m tools.make_scan_pairs --out scan_val.h5 [--config configs/scans.py]
    cfr calibrate scan --data scan_val.h5 --out scan.safetensors

The config's validation part names them: LiDAR frames and pairs of depth images. The clouds are
whole and have no normals, like those of users.
"""

from __future__ import annotations

import argparse
import runpy
import tempfile
from pathlib import Path

import h5py
import numpy as np

from cfr_jax.data.mixture import open_mixture
from cfr_jax.data.scenes import SceneSource


def main() -> None:
    """Writes the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--config", default="configs/scans.py")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    given = runpy.run_path(args.config)["get_config"]().data.validation
    with tempfile.TemporaryDirectory() as cache, h5py.File(args.out, "w") as file:
        for number, source in enumerate(open_mixture(given, Path(cache), "validation").sources):
            assert isinstance(source, SceneSource), "wanted scans, not shapes"
            for row in range(len(source)):
                pair = source.read(row)
                group = file.create_group(f"{number}_{row:03d}")
                group["source"] = np.float32(pair.source)
                group["target"] = np.float32(pair.target)
                group["transform"] = pair.transform
            print(f"{len(source)} {source.noun}")


if __name__ == "__main__":
    main()
