"""One of the paper's ablations: --config=configs/eval_ablations.py:weights

For trainings with another number of steps: --config=configs/eval_ablations.py:weights,3000.

This is `eval_open_cad.py` with the variants of one ablation as methods. If a variant needs weights
of its own, `ablate.py` trains them with `ablations.py`.
"""

import runpy
from pathlib import Path

from cfr_jax.evaluation.config import EvaluationConfig, MethodEntry

# For each ablation its methods; for each method the training of `ablations.py` that it needs ("":
# none), and the settings that it changes.
ABLATIONS = {
    # table 3 of the paper: a light layer of its own for each iteration, or one for all
    "weights": {"own_weights": ("cfr", {}), "shared_weights": ("shared", {})},
    # iteration i runs i Sinkhorn passes, or five in each
    "passes": {"passes_i": ("cfr", {}), "passes_5": ("constant_passes", {"passes": 5})},
    # the same results at different cost
    "sinkhorn": {"log_free": ("", {"match": "dense"}), "log_space": ("", {"match": "log space"})},
    # annealing parameters predicted for all iterations at once, or again in each
    "annealing": {
        "annealing_batched": ("cfr", {}),
        "annealing_each": ("annealing_each", {"repeat_annealing": True}),
    },
    # features passed on from iteration to iteration, or extracted again in each
    "features": {
        "cascade": ("cfr", {}),
        "extraction_each": ("extraction_each", {"repeat_extraction": True}),
    },
    "normals": {"exact_normals": ("", {}), "estimated_normals": ("", {})},
}


def get_config(chosen: str = "weights") -> EvaluationConfig:
    """The evaluation of an ablation; `chosen` is its name, optionally followed by the number of
    steps of its trainings."""
    # a config is a file, not a module, so it is loaded by its path
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
    """The folder where a variant is trained; another number of steps has another folder."""
    return f"runs/ablations_{steps}/{variant}" if steps else f"runs/ablations/{variant}"
