"""DCP trained as published, on our pairs: --config=configs/dcp.py, or :v1, and on a GPU as

    python train.py --config=configs/dcp.py --workdir=runs/dcp --config.train.minutes=10 \\
        --config.train.draw=device --config.train.steps_at_once=10

Adam at 1e-3 with L2 1e-4, batches of 32, rates a tenth of themselves at 0.3, 0.6 and 0.8 of the
training (75, 150 and 200 of 250 epochs). Pairs are those of RPM-Net's partial protocol: cropped,
noisy, each cloud sampled by itself. The published ones have no crop and no noise, and both clouds
are the same points: --config=configs/dcp.py:v2,copied
"""

from cfr_jax.training.config import Phase, SamplingSection, TrainingConfig, TrainSection


def get_config(chosen: str = "v2") -> TrainingConfig:
    """A version, and perhaps "copied" behind a comma."""
    version, _, pairs = chosen.partition(",")
    copied = {"": False, "copied": True}[pairs]
    return TrainingConfig(
        network="dcp",
        version=version,
        iterations=1,
        phases=(Phase(steps=8000, points=1024 if copied else 717, neighbors=19, batch=32),),
        sampling=SamplingSection.plain(
            keep=(1.0, 1.0) if copied else (0.7, 0.7),
            noise=(0.0, 0.0) if copied else (0.01, 0.01),
            copied=copied,
        ),
        train=TrainSection(
            optimizer="adam",
            schedule="stairs",
            peak_rate=1e-3,
            drops=(0.3, 0.6, 0.8),
            weight_decay=1e-4,
            clip=1e6,  # none, as published
            average_decay=0.0,  # the same
            pairs_at_once=32,  # batch norm is over so many
        ),
        validate_every=500,
        validation_pairs=155,
    )
