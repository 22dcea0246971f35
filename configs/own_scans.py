"""Training on scans of your own: a folder of single scans, and perhaps pairs with known motions.

See docs/train-on-your-data.md.
"""

import runpy
from pathlib import Path

from ml_collections import ConfigDict


def get_config() -> ConfigDict:
    """As `scans.py`, with the data that you name: --config.data.train.scans.path=FOLDER and so on.

    A source is left out where its `repeat` is 0.
    """
    # a config is a file and no module: it is found beside this one
    beside = Path(__file__).with_name("scans.py")
    config = runpy.run_path(str(beside))["get_config"]()
    config.data = ConfigDict()
    config.data.train = {
        # views of one scan, turned and cropped: needs no known motion
        "scans": {"kind": "scans", "path": "", "repeat": 1},
        # a CSV list `source,target,16 numbers`, or HDF5
        "pairs": {"kind": "pairs", "path": "", "repeat": 0},
    }
    config.data.validation = {
        "scans": {"kind": "scans", "path": "", "repeat": 1},
        "pairs": {"kind": "pairs", "path": "", "repeat": 0},
    }
    config.phases = ({"steps": 2000, "points": 1024, "neighbors": 32, "batch": 8},)
    config.validate_every = 250

    config.sampling.keep = (0.5, 0.9)
    config.sampling.both_ways = 1.0
    config.sampling.estimated_normals = 0.7  # of those that have normals; the rest always
    config.sampling.noise = (0.0, 0.01)
    config.sampling.outliers = (0.0, 0.03)
    return config
