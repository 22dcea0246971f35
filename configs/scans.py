"""Fine-tuning on real scans: frames of a drive and pairs of depth images, with known motions.

Validation uses separate frames that no training pair shares; `train.py` checks this. The last
frames of both (52 to 69 of the drive, 400 to 500 of the images) are left for `evaluate.py`.
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
    "distances": (2.0, 5.0, 10.0),  # meters between the frames of a pair
    "stride": 1,  # frames
}
RGBD = {"kind": "pair-file", "path": "data/scans/rgbd/pairs.h5"}


def get_config() -> TrainingConfig:
    """Starts from shipped weights, with a lower rate and gentler augmentation."""
    return TrainingConfig(
        # `repeat`: how often per epoch; 0 leaves a source out (--config.data.train.lidar.repeat=0)
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
            keep=(0.7, 1.0),  # scans already overlap only in part
            translation=0.15,  # each cloud lies about its own centroid
            both_ways=1.0,
            any_orientation=0.5,
            scale=(0.85, 1.15),
            noise=(0.0, 0.005),  # scans have noise of their own
            uneven=0.2,
            estimated_normals=1.0,  # these scans have no exact normals
        ),
        train=TrainSection(peak_rate=3e-4, start_from="object"),
        validate_every=125,
        validation_pairs=100,
    )
