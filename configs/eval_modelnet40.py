"""Evaluation on ModelNet40 as published: partial, noisy pairs of the 20 unseen categories."""

import runpy
from pathlib import Path

from ml_collections import ConfigDict


def get_config() -> ConfigDict:
    """As `eval_open_cad.py` with all its settings, on the benchmark's 1,266 test shapes."""
    # a config is a file and no module: it is found beside this one
    beside = Path(__file__).with_name("eval_open_cad.py")
    config = runpy.run_path(str(beside))["get_config"]()
    config.title = "ModelNet40, partial pairs of unseen categories"
    config.data = ConfigDict()
    config.data.kind = "modelnet40"
    config.data.path = "../shared/data/modelnet40_ply_hdf5_2048"
    config.data.split = "test"
    config.data.protocol = "partial"
    config.limit = 0
    return config
