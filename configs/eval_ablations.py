"""The paper's ablations, one each: --config=configs/eval_ablations.py:weights

Of trainings of another length it is --config=configs/eval_ablations.py:weights,3000.

As `eval_open_cad.py`, with the variants of one ablation as methods. Where a variant needs weights
of its own, they are those that `ablate.py` trains by `ablations.py`.
"""

import runpy
from pathlib import Path

from cfr_jax.evaluation.config import EvaluationConfig, MethodEntry

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


def get_config(chosen: str = "weights") -> EvaluationConfig:
    """An ablation, and perhaps how many steps its trainings took."""
    # a config is a file and no module: it is found beside this one
    beside = Path(__file__).with_name("eval_open_cad.py")
    config = runpy.run_path(str(beside))["get_config"]()
    ablation, _, steps = chosen.partition(",")
    config.title = f"Ablation: {ablation}"
    if trainings(ablation):
        short = Path(__file__).with_name("ablations.py")
        taken = int(steps or runpy.run_path(str(short))["STEPS"])
        config.title += f" (after short trainings of {taken:,} steps)"
    config.methods = {
        name: MethodEntry(
            "cfr",
            {"refine": False, "settings": settings},
            weights=f"{workdir(run, steps)}/weights.safetensors" if run else "",
            batch=8,
            estimated_normals=name.startswith("estimated"),
            modules=True,
        )
        for name, (run, settings) in ABLATIONS[ablation].items()
    }
    return config


def trainings(ablation: str) -> tuple[str, ...]:
    """The variants of `ablations.py` that an ablation compares."""
    return tuple(dict.fromkeys(run for run, _ in ABLATIONS[ablation].values() if run))


def workdir(variant: str, steps: str = "") -> str:
    """Where a variant is trained; by another number of steps, in another folder."""
    return f"runs/ablations_{steps}/{variant}" if steps else f"runs/ablations/{variant}"
