"""Training on your own scans: a folder of single scans, and optionally pairs with known motions.

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
    """Starts from shipped weights. Set the folder by --config.data.train.scans.path=FOLDER."""
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
            estimated_normals=0.7,  # for pairs that have normals; without them, always
        ),
        train=TrainSection(peak_rate=3e-4, start_from="object"),
        validate_every=250,
        validation_pairs=100,
    )


def sources() -> dict[str, dict[str, Any]]:
    """The possible sources. A source with `repeat` 0 is left out."""
    return {
        # both clouds are views of one scan, rotated and cropped: no known motion is needed
        "scans": {"kind": "clouds", "path": "", "repeat": 1},
        # a CSV list `source,target,16 numbers`, or HDF5
        "pairs": {"kind": "auto", "path": "", "repeat": 0},
    }
