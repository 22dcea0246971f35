"""Trains `object` further on one or more GPUs, which also draw the pairs; bfloat16; a time budget.

    python train.py --config=configs/object_gpu.py --workdir=runs/object_gpu \\
        --config.data.train=train.h5 --config.data.validation=val.h5 --config.train.minutes=10

The minutes include compilation and validations. To give a number of steps instead:

    --config.train.minutes=0 '--config.phases[0].steps=8000'

Eight GPUs can share the batch of 64, but a larger batch uses them better:

    '--config.phases[0].batch=512'
"""

from cfr_jax.training.config import Phase, TrainingConfig, TrainSection


def get_config() -> TrainingConfig:
    """The size, the data and the augmentation of the last phase of `object.py`."""
    return TrainingConfig(
        phases=(
            Phase(
                steps=0,  # as many as fit into the minutes
                points=717,
                neighbors=64,
                batch=64,
                sampling={"estimated_normals": 0.6},
            ),
        ),
        train=TrainSection(
            start_from="object",
            optimizer="muon",
            schedule="trapezoid",
            peak_rate=1e-3,
            warmup=0.02,
            cooldown=0.5,  # the weights improve most while the rate falls
            precision="bfloat16",
            draw="device",
            steps_at_once=25,  # about a second
            minutes=10.0,
            pairs_at_once=64,
        ),
        log_every=100,
        checkpoint_every=1000,
        validate_every=1000,  # that is, for about one second of every half minute
        validation_pairs=310,
    )
