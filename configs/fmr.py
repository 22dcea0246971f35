"""FMR trained as published, on our pairs: --config=configs/fmr.py, and on a GPU as

    python train.py --config=configs/fmr.py --workdir=runs/fmr --config.train.minutes=10 \\
        --config.train.draw=device --config.train.steps_at_once=10

Adam at 1e-3, batches of 8, no schedule. As published the autoencoder alone learns, and the motion
is found with what it learned; with --config=configs/fmr.py:supervised the motion is trained, too
("semi-supervised" there). Pairs are those of RPM-Net's partial protocol. The published ones have no
crop and no noise, and both clouds are the same points: --config=configs/fmr.py:supervised,copied
"""

from cfr_jax.training.config import Phase, SamplingSection, TrainingConfig, TrainSection


def get_config(chosen: str = "unsupervised") -> TrainingConfig:
    """What is trained, and perhaps "copied" behind a comma."""
    kind, _, pairs = chosen.partition(",")
    copied = {"": False, "copied": True}[pairs]
    return TrainingConfig(
        network="fmr",
        iterations=10,
        settings={"supervised": {"unsupervised": False, "supervised": True}[kind]},
        phases=(Phase(steps=16000, points=1024 if copied else 717, neighbors=1, batch=8),),
        sampling=SamplingSection.plain(
            keep=(1.0, 1.0) if copied else (0.7, 0.7),
            noise=(0.0, 0.0) if copied else (0.01, 0.01),
            copied=copied,
        ),
        train=TrainSection(
            optimizer="adam",
            schedule="stairs",
            peak_rate=1e-3,
            weight_decay=0.0,
            clip=1e6,  # none, as published
            average_decay=0.0,  # the same
            pairs_at_once=8,  # batch norm is over so many
        ),
        validate_every=1000,
        validation_pairs=155,
    )
