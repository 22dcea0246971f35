"""Training on the open CAD corpus: partial, noisy pairs of the 24 seen categories.

This is the recipe that `cfr_jax/training/config.py` has as its defaults, each with its unit or its
reason. The corpus comes from `cfr data open-cad --out data/open_cad`; any other file in the
ModelNet40 layout will do.
"""

from cfr_jax.training.config import TrainingConfig


def get_config() -> TrainingConfig:
    """About two hours on two cores."""
    return TrainingConfig()
