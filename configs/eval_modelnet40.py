"""Evaluation on ModelNet40 as published: partial, noisy pairs of the 20 unseen categories."""

import runpy
from pathlib import Path

from cfr_jax.evaluation.config import EvaluationConfig


def get_config() -> EvaluationConfig:
    """The methods of `eval_open_cad.py` on the benchmark's 1,266 test shapes."""
    # a config is a file, not a module, so it is loaded by its path
    beside = Path(__file__).with_name("eval_open_cad.py")
    return EvaluationConfig(
        title="ModelNet40, partial pairs of unseen categories",
        data={
            "kind": "modelnet40",
            "path": "data/modelnet40_ply_hdf5_2048",
            "split": "test",
            "protocol": "partial",
        },
        methods=runpy.run_path(str(beside))["exact"](),
    )
