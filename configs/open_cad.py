"""Training on the open CAD corpus: partial, noisy pairs of the 24 seen categories.

This recipe is the defaults in `cfr_jax/training/config.py`, where each has its unit or its reason.
The corpus comes from `cfr data open-cad --out data/open_cad`; any other file in the ModelNet40
layout works too.
"""

from cfr_jax.training.config import TrainingConfig


def get_config() -> TrainingConfig:
    """Takes about two hours on two cores."""
    return TrainingConfig()
