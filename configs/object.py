"""A long training on the open CAD corpus, with the data and augmentation of `open_cad.py`.

It takes about ten hours on two cores. A restart loses only the steps since the last checkpoint, so
you can split the run into several.
"""

from cfr_jax.training.config import Phase, TrainingConfig, TrainSection


def get_config() -> TrainingConfig:
    """The weights `object`."""
    # more of them, after exact normals have become easy
    estimated = {"estimated_normals": 0.6}
    return TrainingConfig(
        # In every phase, neighborhoods cover the same part of the shape as in the test. (For the
        # reason see "Neighborhoods" in docs/notes/training.md.)
        phases=(
            Phase(steps=6000, points=256, neighbors=24, batch=8),
            Phase(steps=4750, points=358, neighbors=32, batch=8),
            Phase(steps=5250, points=358, neighbors=32, batch=8, sampling=estimated),
            Phase(steps=10800, points=717, neighbors=64, batch=8, sampling=estimated),
        ),
        train=TrainSection(optimizer="muon", schedule="wsd", warmup=0.0238, cooldown=0.15),
        validate_every=1000,
        validation_pairs=155,
    )
