"""RGM trained as published, on our pairs: --config=configs/rgm.py, and on a GPU as

    python train.py --config=configs/rgm.py:128 --workdir=runs/rgm --config.train.minutes=10 \\
        --config.train.draw=device --config.train.steps_at_once=10

SGD with Nesterov's momentum at 1e-3, batches of 4, rates a fifth of themselves at 0.6 and 0.7 of
the training (120 and 140 of 200 epochs). What stands behind the colon is the width of the features:
the published 512 are 25 million parameters and days on a GPU, 128 are 1.6 million, and no longer
the published network. Pairs are those of RPM-Net's partial protocol. In the published ones both
clouds are the same points, cropped and made noisy one by one: --config=configs/rgm.py:128,copied
"""

from cfr_jax.training.config import Phase, SamplingSection, TrainingConfig, TrainSection


def get_config(chosen: str = "512") -> TrainingConfig:
    """A width, and perhaps "copied" behind a comma."""
    width, _, pairs = chosen.partition(",")
    return TrainingConfig(
        network="rgm",
        width=int(width),
        iterations=1,
        phases=(Phase(steps=16000, points=717, neighbors=19, batch=4),),
        sampling=SamplingSection.plain(
            keep=(0.7, 0.7),
            copied={"": False, "copied": True}[pairs],
        ),
        train=TrainSection(
            optimizer="sgd",
            schedule="stairs",
            peak_rate=1e-3,
            drops=(0.6, 0.7),
            drop_factor=0.2,
            weight_decay=0.0,
            clip=1e6,  # none, as published
            average_decay=0.0,  # the same
            pairs_at_once=4,  # batch norm is over so many
        ),
        validate_every=1000,
        validation_pairs=155,
    )
