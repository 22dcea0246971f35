"""Training on scans of your own: a folder of single scans, and perhaps pairs with known motions.

See docs/train-on-your-data.md.
"""

from typing import Any

from cfr_jax.training.config import (
    DataSection,
    Phase,
    SamplingSection,
    TrainingConfig,
    TrainSection,
)


def get_config() -> TrainingConfig:
    """From shipped weights on. Say where scans are: --config.data.train.scans.path=FOLDER."""
    return TrainingConfig(
        data=DataSection(train=sources(), validation=sources()),
        phases=(Phase(steps=2000, points=1024, neighbors=32, batch=8),),
        sampling=SamplingSection(
            keep=(0.5, 0.9),
            translation=0.15,  # each cloud lies about its own centroid
            both_ways=1.0,
            any_orientation=0.5,
            scale=(0.85, 1.15),
            noise=(0.0, 0.01),
            outliers=(0.0, 0.03),
            uneven=0.2,
            estimated_normals=0.7,  # of those that have normals; the rest always
        ),
        train=TrainSection(peak_rate=3e-4, start_from="object"),
        validate_every=250,
        validation_pairs=100,
    )


def sources() -> dict[str, dict[str, Any]]:
    """What there may be. A source whose `repeat` is 0 is left out."""
    return {
        # views of one scan, turned and cropped: needs no known motion
        "scans": {"kind": "clouds", "path": "", "repeat": 1},
        # a CSV list `source,target,16 numbers`, or HDF5
        "pairs": {"kind": "auto", "path": "", "repeat": 0},
    }
