"""A long training on the open CAD corpus: the data and augmentation of `open_cad.py`.

Some ten hours on two cores. A restart costs nothing but the steps since the last checkpoint, so
the run may be made in pieces.
"""

import runpy
from pathlib import Path

from ml_collections import ConfigDict


def get_config() -> ConfigDict:
    """Everything that `train.py` reads."""
    # a config is a file and no module: it is found beside this one
    beside = Path(__file__).with_name("open_cad.py")
    config = runpy.run_path(str(beside))["get_config"]()
    # Neighborhoods cover the same patch of the shape in every phase, that of the test (why:
    # docs/training.md, "Neighborhoods").
    estimated = {"estimated_normals": 0.6}  # more, once the exact ones have become easy
    config.phases = (
        {"steps": 6000, "points": 256, "neighbors": 24, "batch": 8},
        {"steps": 4750, "points": 358, "neighbors": 32, "batch": 8},
        {"steps": 5250, "points": 358, "neighbors": 32, "batch": 8, "sampling": estimated},
        {"steps": 10800, "points": 717, "neighbors": 64, "batch": 8, "sampling": estimated},
    )
    config.train.optimizer = "muon"
    config.train.schedule = "wsd"
    config.train.warmup = 0.0238
    config.train.cooldown = 0.15
    config.checkpoint_every = 250
    config.validate_every = 1000
    config.validation_pairs = 155
    return config
