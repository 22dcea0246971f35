"""Writes the pairs that the weights `scan` were validated on, as one file of pairs.

    python -m tools.make_scan_pairs --out scan_val.h5 [--config configs/scans.py]
    cfr calibrate scan --data scan_val.h5 --out scan.safetensors

They are the validation part of the config: frames of the drive and pairs of depth images, whole and
without normals, as a user has them.
"""

from __future__ import annotations

import argparse
import runpy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from cfr_jax.data import kitti
from cfr_jax.data.pairs import Hdf5Pairs, among


def drives(source: dict[str, Any]) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Source, target and truth of each pair of frames, as they were recorded."""
    for sequence in source["sequences"]:
        for distance in source["distances"]:
            scans = kitti.read_pairs(
                source["path"], sequence, distance=distance, stride=source["stride"]
            )
            for row, frames in enumerate(scans.frames.tolist()):
                if among(source["frames"], frames):
                    clouds = (kitti.read_frame(scans.folder, sequence, f) for f in frames)
                    yield *clouds, scans.transforms[row]


def images(source: dict[str, Any]) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """The same of the pairs in a file."""
    held = Hdf5Pairs(source["path"])
    for row in range(len(held)):
        if among(source["frames"], held.frames(row)):
            pair = held[row]
            yield pair.source, pair.target, pair.transform


def main() -> None:
    """Writes the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--config", default="configs/scans.py")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    sources = runpy.run_path(args.config)["get_config"]().data.validation
    with h5py.File(args.out, "w") as file:
        for name, source in sources.items():
            made = {"kitti": drives, "pairs": images}[source["kind"]](source)
            count = 0
            for count, (first, second, truth) in enumerate(made, 1):
                group = file.create_group(f"{name}_{count:03d}")
                group["source"], group["target"] = np.float32(first), np.float32(second)
                group["transform"] = truth
            print(f"{name}: {count} pairs")


if __name__ == "__main__":
    main()
