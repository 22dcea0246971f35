"""As `eval_open_cad.py`, turned by any rotation, and with the search over all of them."""

import runpy
from pathlib import Path

from ml_collections import ConfigDict


def get_config() -> ConfigDict:
    """Everything that `evaluate.py` reads."""
    # a config is a file and no module: it is found beside this one
    known = runpy.run_path(str(Path(__file__).with_name("eval_open_cad.py")))
    config = known["get_config"]()
    config.title = "Open CAD shapes, partial pairs turned by any rotation"
    config.data.protocol = "partial_any_rotation"
    config.limit = 150  # the search takes seconds a pair
    config.methods.cfr_global = known["network"](
        "cfr", refine=True, through="align", initial="global"
    )
    return config
