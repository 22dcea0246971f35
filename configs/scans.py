"""Fine-tuning on real scans: frames of a drive and pairs of depth images, with known motions.

Validated on frames of its own, which no training pair shares; `train.py` refuses anything else. The
last frames of both (`data.test_frames`) are left for `evaluate.py`.
"""

import runpy
from pathlib import Path

from ml_collections import ConfigDict


def get_config() -> ConfigDict:
    """As `open_cad.py`, from the shipped weights on, at a lower rate, with gentler augmentation."""
    # a config is a file and no module: it is found beside this one
    beside = Path(__file__).with_name("open_cad.py")
    config = runpy.run_path(str(beside))["get_config"]()
    lidar = {"kind": "kitti", "path": "../shared/data/scans/lidar", "sequences": ("00",)}
    lidar |= {"distances": (2.0, 5.0, 10.0), "stride": 1}  # m between the frames; frames
    rgbd = {"kind": "pairs", "path": "../shared/data/scans/rgbd/pairs.h5"}

    # `repeat`: times an epoch; 0 leaves a source out, as in --config.data.train.lidar.repeat=0
    config.data = ConfigDict()
    config.data.train = {
        "lidar": lidar | {"frames": (0, 36), "repeat": 1},
        "rgbd": rgbd | {"frames": (0, 300), "repeat": 2},
    }
    config.data.validation = {
        "lidar": lidar | {"frames": (36, 52), "repeat": 1},
        "rgbd": rgbd | {"frames": (300, 400), "repeat": 1},
    }
    config.data.test_frames = {"lidar": (52, 69), "rgbd": (400, 500)}

    config.phases = ({"steps": 500, "points": 1024, "neighbors": 32, "batch": 8},)

    config.sampling.keep = (0.7, 1.0)  # scans overlap in part as they are
    config.sampling.translation = 0.15  # each cloud lies about its own centroid
    config.sampling.both_ways = 1.0
    config.sampling.any_orientation = 0.5
    config.sampling.scale = (0.85, 1.15)
    config.sampling.noise = (0.0, 0.005)  # they have their own
    config.sampling.uneven = 0.2
    config.sampling.estimated_normals = 1.0  # these scans have no others

    config.train.peak_rate = 3e-4
    config.train.start_from = "object"
    config.validation_pairs = 100
    config.validate_every = 125
    return config
