"""Fine-tuning on real scans: frames of a drive and pairs of depth images, with known motions.

Validated on frames of its own, which no training pair shares; `train.py` refuses anything else. The
last frames of both (52 to 69 of the drive, 400 to 500 of the images) are left for `evaluate.py`.
"""

from cfr_jax.training.config import (
    DataSection,
    Phase,
    SamplingSection,
    TrainingConfig,
    TrainSection,
)

LIDAR = {
    "kind": "kitti",
    "path": "data/scans/lidar",
    "sequences": ("00",),
    "distances": (2.0, 5.0, 10.0),  # m between the frames
    "stride": 1,  # frames
}
RGBD = {"kind": "pair-file", "path": "data/scans/rgbd/pairs.h5"}


def get_config() -> TrainingConfig:
    """From shipped weights on, at a lower rate, with gentler augmentation."""
    return TrainingConfig(
        # `repeat`: times an epoch; 0 leaves a source out, as in --config.data.train.lidar.repeat=0
        data=DataSection(
            train={
                "lidar": LIDAR | {"frames": (0, 36), "repeat": 1},
                "rgbd": RGBD | {"frames": (0, 300), "repeat": 2},
            },
            validation={
                "lidar": LIDAR | {"frames": (36, 52), "repeat": 1},
                "rgbd": RGBD | {"frames": (300, 400), "repeat": 1},
            },
        ),
        phases=(Phase(steps=500, points=1024, neighbors=32, batch=8),),
        sampling=SamplingSection(
            keep=(0.7, 1.0),  # scans overlap in part as they are
            translation=0.15,  # each cloud lies about its own centroid
            both_ways=1.0,
            any_orientation=0.5,
            scale=(0.85, 1.15),
            noise=(0.0, 0.005),  # they have their own
            uneven=0.2,
            estimated_normals=1.0,  # these scans have no others
        ),
        train=TrainSection(peak_rate=3e-4, start_from="object"),
        validate_every=125,
        validation_pairs=100,
    )
