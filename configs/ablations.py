"""Short trainings of the paper's network and of variants: --config=configs/ablations.py:shared

Another number of steps is written behind: --config=configs/ablations.py:shared,3000. Data, loss and
optimizer are those of `open_cad.py`. Every variant takes the same number of steps, a fraction of
what a good model wants, on small clouds: enough to tell them apart, and no more. `ablate.py` runs
them, and compares them at full size.
"""

import runpy
from pathlib import Path

from ml_collections import ConfigDict

STEPS = 1000
# What a variant does otherwise: `prepared.Settings`, or one light layer for all iterations.
VARIANTS = {
    "cfr": {},
    "shared": {"shared": True},
    "constant_passes": {"settings": {"passes": 5}},
    "annealing_each": {"settings": {"repeat_annealing": True}},
    "extraction_each": {"settings": {"repeat_extraction": True}},
}


def get_config(chosen: str = "cfr") -> ConfigDict:
    """Everything that `train.py` reads."""
    variant, _, steps = chosen.partition(",")
    # a config is a file and no module: it is found beside this one
    beside = Path(__file__).with_name("open_cad.py")
    config = runpy.run_path(str(beside))["get_config"]()
    changes = VARIANTS[variant]
    config.shared = changes.get("shared", False)
    config.settings = ConfigDict(changes.get("settings", {}))
    config.phases = ({"steps": int(steps or STEPS), "points": 256, "neighbors": 24, "batch": 8},)
    config.validation_pairs = 93
    # turned as the protocol has it and about the shape's middle, as the recipe was when these ran
    config.sampling.update(both_ways=0.0, near=0.0, centered=0.0)
    return config
