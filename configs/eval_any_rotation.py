"""`eval_open_cad.py` with pairs rotated by any rotation, and with a search over all rotations."""

import runpy
from pathlib import Path

from cfr_jax.evaluation.config import EvaluationConfig, MethodEntry


def get_config() -> EvaluationConfig:
    """Adds `cfr_global` to the other methods."""
    # a config is a file, not a module, so it is loaded by its path
    beside = Path(__file__).with_name("eval_open_cad.py")
    config = runpy.run_path(str(beside))["get_config"]()
    config.title = "Open CAD shapes, partial pairs rotated by any rotation"
    config.data["protocol"] = "partial_any_rotation"
    config.limit = 150  # the search takes seconds per pair
    searching = {"refine": True, "through": "align", "initial": "global"}
    config.methods["cfr_global"] = MethodEntry("cfr", searching, batch=8)
    return config
