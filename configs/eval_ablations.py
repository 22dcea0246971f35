"""The paper's ablations, one each: --config=configs/eval_ablations.py:weights

Of trainings of another length it is --config=configs/eval_ablations.py:weights,3000.

As `eval_open_cad.py`, with the variants of one ablation as methods. Where a variant needs weights
of its own, they are those that `ablate.py` trains in `config.runs`, by `ablations.py`.
"""

import runpy
from pathlib import Path

from ml_collections import ConfigDict

# By ablation: its methods, what each does otherwise, and which training of `ablations.py` it needs.
ABLATIONS = {
    # table 3 of the paper: a light layer of its own for each iteration, or one for all
    "weights": {"own_weights": ("cfr", {}), "shared_weights": ("shared", {})},
    # iteration i runs i Sinkhorn passes, or five in each
    "passes": {"passes_i": ("cfr", {}), "passes_5": ("constant_passes", {"passes": 5})},
    # the same numbers, and what they cost
    "sinkhorn": {"log_free": ("", {"match": "dense"}), "log_space": ("", {"match": "log space"})},
    # annealing parameters of all iterations at once, or anew in each
    "annealing": {
        "annealing_batched": ("cfr", {}),
        "annealing_each": ("annealing_each", {"repeat_annealing": True}),
    },
    # features handed on from iteration to iteration, or extracted anew in each
    "features": {
        "cascade": ("cfr", {}),
        "extraction_each": ("extraction_each", {"repeat_extraction": True}),
    },
    "normals": {"exact_normals": ("", {}), "estimated_normals": ("", {})},
}


def get_config(chosen: str = "weights") -> ConfigDict:
    """Everything that `evaluate.py` reads, and `trainings`, which `ablate.py` reads."""
    # a config is a file and no module: it is found beside this one
    beside = Path(__file__).with_name("eval_open_cad.py")
    config = runpy.run_path(str(beside))["get_config"]()
    ablation, _, steps = chosen.partition(",")
    variants = ABLATIONS[ablation]
    # where the weights of the trainings are
    config.runs = f"runs/ablations_{steps}" if steps else "runs/ablations"
    config.trainings = tuple(dict.fromkeys(run for run, _ in variants.values() if run))
    config.title = f"Ablation: {ablation}"
    if config.trainings:
        short = Path(__file__).with_name("ablations.py")
        steps = steps or runpy.run_path(str(short))["STEPS"]
        config.title += f" (after short trainings of {int(steps):,} steps)"
    config.methods = ConfigDict()
    for name, (run, settings) in variants.items():
        entry = {"use": "cfr", "batch": 8, "modules": True}
        entry["options"] = {"refine": False, "settings": settings}
        entry["estimated_normals"] = name.startswith("estimated")
        if run:
            entry["weights"] = f"{config.runs}/{run}/weights.safetensors"
        config.methods[name] = entry
    return config
