"""Compares methods: python evaluate.py --config=configs/eval_open_cad.py --out=results/open_cad

Any field of the config can be set on the command line, for example --config.data.protocol=clean;
cfr_jax/evaluation/config.py explains all fields. To resume an interrupted run, or to add methods to
an earlier one, run the command again. The exit code is 1 after an error, and also if a method ran
and answered no pair.
"""

import shlex
import sys
from pathlib import Path

from absl import flags, logging
from ml_collections import config_flags

from cfr_jax.cli.shared import configured

_CONFIG = config_flags.DEFINE_config_file("config", None, "The data, the methods, their settings.")
_OUT = flags.DEFINE_string("out", None, "Folder for results.json, table.md, plots and gallery.")
_METHODS = flags.DEFINE_list("methods", [], "Which of the config's methods to run (default: all).")
_WEIGHTS = flags.DEFINE_string("weights", None, "Shipped weights by name, or a .safetensors file.")
_LIMIT = flags.DEFINE_integer("limit", None, "How many pairs, from the first; 0 for all.")
_SEED = flags.DEFINE_integer("seed", None, "Seed of random methods and of the intervals.")
_PLOTS = flags.DEFINE_bool("plots", True, "Whether to draw plots and galleries.")


def main(_) -> None:
    """Reads the flags; the work is done in `cfr_jax.evaluation`."""
    from cfr_jax.evaluation.comparison import compare
    from cfr_jax.evaluation.multiway.comparison import compare_merges
    from cfr_jax.evaluation.multiway.config import MergeConfig

    logging.set_verbosity(logging.ERROR)  # JAX logs every backend that is missing
    config = _CONFIG.value
    for name, flag in (("weights", _WEIGHTS), ("limit", _LIMIT), ("seed", _SEED)):
        if flag.value is not None:
            setattr(config, name, flag.value)
    command = shlex.join(["python", *sys.argv])
    try:
        if isinstance(config, MergeConfig):
            print(compare_merges(config, Path(_OUT.value), _METHODS.value, command))
            return
        found = compare(config, Path(_OUT.value), _METHODS.value, _PLOTS.value, command)
    except (ValueError, ModuleNotFoundError) as error:
        sys.exit(f"evaluate.py: error: {error}")
    print(found.table, flush=True)
    if found.unanswered:
        told = (f"{name} answered no pair: {why}" for name, why in found.unanswered.items())
        sys.exit("evaluate.py: error: " + "; ".join(told))


if __name__ == "__main__":
    flags.mark_flags_as_required(["config", "out"])
    configured.run(main)
