"""`eval_open_cad.py` at one overlap: --config=configs/eval_overlap.py:3 is 0.3, from 1 to 9.

Each shape is cut across a random direction from both ends, turned by up to 45 degrees either way
about each axis. The table of docs/results.md has one row per overlap.
"""

import runpy
from pathlib import Path

from cfr_jax.evaluation.config import EvaluationConfig


def get_config(tenths: str = "3") -> EvaluationConfig:
    """Ours as a user calls it, and the two methods by features that did best."""
    # a config is a file, not a module, so it is loaded by its path
    beside = Path(__file__).with_name("eval_open_cad.py")
    config = runpy.run_path(str(beside))["get_config"]()
    config.title = f"Open CAD shapes, overlap 0.{tenths}"
    config.data["protocol"] = f"overlap_{tenths}"
    config.limit = 150
    chosen = ("cfr_align", "fgr_icp", "kiss_matcher")
    config.methods = {name: config.methods[name] for name in chosen}
    return config
