"""Trains and compares the variants of an ablation: python ablate.py --ablation=weights

The ablations are weights, passes, sinkhorn, annealing, features and normals (`eval_ablations.py`).
Variants that need training are trained for a short time by `train.py`, in runs/ablations; all
ablations share these runs. `evaluate.py` does the rest. To resume, run the same command again.
"""

import runpy
import subprocess
import sys
from pathlib import Path

from absl import app, flags

_HERE = Path(__file__).resolve().parent
_EVALUATION = _HERE / "configs" / "eval_ablations.py"
_ABLATION = flags.DEFINE_string("ablation", None, "Which ablation to run.")
_OUT = flags.DEFINE_string("out", None, "Folder for results (default: results/ablations/NAME).")
_STEPS = flags.DEFINE_integer("steps", None, "Steps of every training, instead of the config's.")
_LIMIT = flags.DEFINE_integer("limit", 300, "How many pairs to compare on; 0 for all.")


def main(_) -> None:
    """Runs `train.py` for each training that the ablation needs, then `evaluate.py`."""
    known = runpy.run_path(str(_EVALUATION))
    name = _ABLATION.value
    if name not in known["ABLATIONS"]:
        names = ", ".join(known["ABLATIONS"])
        raise SystemExit(f"ablate.py: error: --ablation: got {name!r}, wanted one of {names}")
    steps = "" if _STEPS.value is None else str(_STEPS.value)
    chosen = f",{steps}" if steps else ""
    for variant in known["trainings"](name):
        _run(
            "train.py",
            f"--config={_HERE / 'configs' / 'ablations.py'}:{variant}{chosen}",
            f"--workdir={known['workdir'](variant, steps)}",
        )
    _run(
        "evaluate.py",
        f"--config={_EVALUATION}:{name}{chosen}",
        f"--limit={_LIMIT.value}",
        f"--out={_OUT.value or f'results/ablations/{name}'}",
    )


def _run(program: str, *arguments: str) -> None:
    done = subprocess.run([sys.executable, str(_HERE / program), *arguments])
    if done.returncode:
        raise SystemExit(done.returncode)


if __name__ == "__main__":
    flags.mark_flags_as_required(["ablation"])
    app.run(main)
