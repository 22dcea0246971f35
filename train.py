"""Trains the network: python train.py --config=configs/open_cad.py --workdir=runs/open_cad

A config is a Python file that says what differs from the defaults. These are in configs/:

    open_cad.py    the open CAD corpus, about two hours on two cores: the defaults
    object.py      the same for longer: the weights `object`
    object_gpu.py  `object`, trained further on GPUs for some minutes
    scans.py       fine-tuning on real scans: the weights `scan`
    own_scans.py   your own scans (docs/train-on-your-data.md)

Every field, with its default and its meaning, is in cfr_jax/training/config.py. You can set any of
them on the command line; write an item of a list by its position:

    python train.py --config=configs/open_cad.py --workdir=runs/mine \\
        --config.data.train=corpus/train.h5 --config.data.validation=corpus/val.h5 \\
        --config.train.start_from=object --config.train.peak_rate=3e-4 \\
        '--config.phases[0].steps=500'

You can stop it with Ctrl-C, or in any other way: the same command resumes from the last checkpoint
in the workdir. Its measurements are in metrics.jsonl, summary.html and TensorBoard files there, and
the best weights in weights.safetensors, for `cfr register --weights`.
"""

import sys
import warnings
from pathlib import Path

from absl import flags, logging
from ml_collections import config_flags

from cfr_jax.cli.shared import configured

_CONFIG = config_flags.DEFINE_config_file("config", None, "What to train, on what, and how long.")
_WORKDIR = flags.DEFINE_string("workdir", None, "Folder for checkpoints, metrics and weights.")
_COORDINATOR = flags.DEFINE_string(
    "coordinator", "", "HOST:PORT of the first of several processes; all share one workdir."
)
_PROCESSES = flags.DEFINE_integer("processes", 1, "How many processes train together.")
_PROCESS = flags.DEFINE_integer("process", 0, "The number of this process, from 0.")


def main(_) -> None:
    """Reads the flags; the work is done in `cfr_jax.training.loop`."""
    import jax

    from cfr_jax.cli.shared.cache import keep_compiled_programs
    from cfr_jax.training import devices, identity, loop, stopping, validation
    from cfr_jax.training.config import checked

    # orbax logs pages about a full disk; the error is reported below, once
    logging.set_verbosity(logging.FATAL)
    warnings.showwarning = _warn
    workdir = Path(_WORKDIR.value)
    try:
        config = checked(_CONFIG.value)
        if not _COORDINATOR.value:
            cores = devices.of_cores(*(phase.batch for phase in config.phases))
            if cores is not None:
                jax.config.update("jax_num_cpu_devices", cores)
        keep_compiled_programs()
        devices.join(_COORDINATOR.value, _PROCESSES.value, _PROCESS.value)
        best = loop.run(config, workdir)
    except (ValueError, OSError) as error:
        raise SystemExit(f"train.py: error: {error}") from error
    except stopping.Stopped as stopped:
        print(f"train.py: {stopped}", file=sys.stderr)
        sys.exit(128 + stopped.signal)
    if devices.is_first():
        made = workdir / identity.WEIGHTS
        print(f"best at step {best['step']}: {validation.in_words(best)}")
        print(f"weights: {made}; the whole run: {workdir / 'summary.html'}")
        print(f"to use them: cfr register a.ply b.ply --weights {made}")


def _warn(message, *_) -> None:
    print(f"train.py: {message}", file=sys.stderr)


if __name__ == "__main__":
    flags.mark_flags_as_required(["config", "workdir"])
    configured.run(main)
