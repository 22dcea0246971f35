"""`object` gone on with on one GPU, or several: pairs drawn there, bfloat16, a budget of minutes.

    python train.py --config=configs/object_gpu.py --workdir=runs/object_gpu \\
        --config.data.train=train.h5 --config.data.validation=val.h5 --config.train.minutes=10

Compiling and validations are in the minutes. A number of steps instead of them:

    --config.train.minutes=0 '--config.phases[0].steps=8000'

Eight GPUs share a batch of 64 as one does; with a larger one they are used better:

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
            cooldown=0.5,  # most of what the weights gain comes while the rate falls
            precision="bfloat16",
            draw="device",
            steps_at_once=25,  # about a second
            minutes=10.0,
            pairs_at_once=64,
        ),
        log_every=100,
        checkpoint_every=1000,
        validate_every=1000,  # a second of half a minute
        validation_pairs=310,
    )
