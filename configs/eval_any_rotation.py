"""As `eval_open_cad.py`, turned by any rotation, and with the search over all of them."""

import runpy
from pathlib import Path

from cfr_jax.evaluation.config import EvaluationConfig, MethodEntry


def get_config() -> EvaluationConfig:
    """With `cfr_global` beside the other methods."""
    # a config is a file and no module: it is found beside this one
    beside = Path(__file__).with_name("eval_open_cad.py")
    config = runpy.run_path(str(beside))["get_config"]()
    config.title = "Open CAD shapes, partial pairs turned by any rotation"
    config.data["protocol"] = "partial_any_rotation"
    config.limit = 150  # the search takes seconds a pair
    searching = {"refine": True, "through": "align", "initial": "global"}
    config.methods["cfr_global"] = MethodEntry("cfr", searching, batch=8)
    return config
