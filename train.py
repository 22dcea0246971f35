"""Trains the network: python train.py --config=configs/open_cad.py --workdir=runs/open_cad

Any field of the config can be set on the command line, as in --config.train.peak_rate=3e-4. Run the
same command again and it goes on from the last checkpoint in the workdir.
"""

from pathlib import Path

from absl import app, flags
from ml_collections import config_flags

_CONFIG = config_flags.DEFINE_config_file("config", None, "What to train, on what, and how long.")
_WORKDIR = flags.DEFINE_string("workdir", None, "Folder of checkpoints, metrics and weights.")


def main(_) -> None:
    """Everything of interest is in `cfr_jax.trainer`."""
    from cfr_jax import trainer

    try:
        best = trainer.run(_CONFIG.value, Path(_WORKDIR.value))
    except ValueError as error:
        raise SystemExit(f"train.py: error: {error}") from error
    print(f"best validation at step {best['step']}: {best}")


if __name__ == "__main__":
    flags.mark_flags_as_required(["config", "workdir"])
    app.run(main)
