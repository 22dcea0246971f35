"""Training on the open CAD corpus: partial, noisy pairs of the 24 seen categories."""

from ml_collections import ConfigDict


def get_config() -> ConfigDict:
    """Everything that `train.py` reads; override any field as --config.train.peak_rate=3e-4."""
    config = ConfigDict()
    config.seed = 0
    config.network = "cfr"
    config.iterations = 5
    config.shared = False  # one light layer for all iterations, instead of one each
    config.settings = ConfigDict()  # fields of `prepared.Settings` other than the paper's

    config.data = ConfigDict()
    # any file in the ModelNet40 layout, or sources by name, as in scans.py
    config.data.train = "../shared/data/open_cad/train.h5"
    config.data.validation = "../shared/data/open_cad/val.h5"

    # Clouds grow as training goes on: small ones learn the most per second at first, and the
    # weights depend neither on the points nor on the neighbors (docs/training.md). A phase may
    # have a `sampling` of its own: {..., "sampling": {"estimated_normals": 0.6}}.
    config.phases = (
        {"steps": 3000, "points": 256, "neighbors": 24, "batch": 8},
        {"steps": 4000, "points": 717, "neighbors": 32, "batch": 8},
    )

    config.sampling = ConfigDict()
    config.sampling.keep = (0.55, 0.85)  # share left by each crop; the test protocol has 0.7
    config.sampling.angle = 45.0  # degrees, per Euler angle
    config.sampling.translation = 0.5
    config.sampling.both_ways = 0.5  # of the pairs: each angle from [-angle, angle], not [0, angle]
    config.sampling.near = 0.3  # of the pairs: smaller motions, as a second cascade sees them
    config.sampling.centered = 0.4  # of the pairs: clouds about their own centroids, as `align` has
    config.sampling.any_orientation = 0.3  # of the shapes; the rest stand upright, as CAD models do
    config.sampling.scale = (0.8, 1.2)
    config.sampling.uneven = 0.0  # of the pairs: clouds denser on one side, `density` times
    config.sampling.density = (3.0, 10.0)
    config.sampling.outliers = (0.0, 0.0)  # share of the points
    config.sampling.noise = (0.01, 0.01)  # per axis
    config.sampling.sensor_noise = 0.0  # of the pairs: along the rays of a depth sensor instead
    config.sampling.sensor_scale = (0.005, 0.02)  # its standard deviation at the middle
    config.sampling.estimated_normals = 0.4

    config.train = ConfigDict()
    config.train.optimizer = "adamw"  # or adam, lion, sgd, muon
    config.train.schedule = "cosine"  # or wsd (warm-up, stable, decay), constant
    config.train.peak_rate = 1e-3
    config.train.warmup = 0.1  # share of all steps
    config.train.cooldown = 0.2  # the same, of wsd alone
    config.train.clip = 1.0
    config.train.weight_decay = 1e-5
    config.train.correspondence_weight = 0.05
    config.train.average_decay = 0.999
    config.train.precision = (
        "float32"  # of the MLPs' products: or tensorfloat32, bfloat16 (GPU, TPU)
    )
    config.train.pairs_at_once = 1  # on an accelerator: as many as fit; their gradients are summed
    config.train.max_skipped = 20  # steps in a row whose gradient is not finite, before it stops
    config.train.workers = 1
    config.train.start_from = ""  # weights to go on from, instead of fresh ones

    config.log_every = 50  # steps
    config.checkpoint_every = 250
    config.validate_every = 500
    # all of val.h5: on 96, two flipped shapes decided which weights were best
    config.validation_pairs = 465
    config.keep_checkpoints = 2
    return config
