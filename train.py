"""Trains the network: python train.py --config=configs/open_cad.py --workdir=runs/open_cad

Any field of the config can be set on the command line, as in --config.train.peak_rate=3e-4. Run the
same command again and it goes on from the last checkpoint in the workdir.
"""

from pathlib import Path

from absl import app, flags, logging
from ml_collections import config_flags

_CONFIG = config_flags.DEFINE_config_file("config", None, "What to train, on what, and how long.")
_WORKDIR = flags.DEFINE_string("workdir", None, "Folder of checkpoints, metrics and weights.")
_COORDINATOR = flags.DEFINE_string(
    "coordinator", "", "HOST:PORT of the first of several processes; all share one workdir."
)
_PROCESSES = flags.DEFINE_integer("processes", 1, "How many processes train together.")
_PROCESS = flags.DEFINE_integer("process", 0, "Which of them this is, from 0.")


def main(_) -> None:
    """Everything of interest is in `cfr_jax.training.loop`."""
    import jax

    from cfr_jax.training import devices, loop

    # orbax writes pages about a full disk; what went wrong is said below, once
    logging.set_verbosity(logging.FATAL)
    try:
        if not _COORDINATOR.value:
            cores = devices.of_cores(*(phase["batch"] for phase in _CONFIG.value.phases))
            if cores is not None:
                jax.config.update("jax_num_cpu_devices", cores)
        devices.join(_COORDINATOR.value, _PROCESSES.value, _PROCESS.value)
        best = loop.run(_CONFIG.value, Path(_WORKDIR.value))
    except (ValueError, OSError) as error:
        raise SystemExit(f"train.py: error: {error}") from error
    if devices.is_first():
        print(f"best validation at step {best['step']}: {best}")


if __name__ == "__main__":
    flags.mark_flags_as_required(["config", "workdir"])
    app.run(main)
