"""The config of a training: every field with its default, and its unit or the reason for it.

The defaults are the recipe for the open CAD corpus; a file in `configs/` states what differs. Flags
of `train.py` set single fields (`--config.train.peak_rate=3e-4`), one after the other, according to
the types given here. `checked` then checks the whole config.
"""

# No `from __future__ import annotations`: ml_collections reads the types of the fields.
import dataclasses
from dataclasses import dataclass, field
from typing import Any

from cfr_jax.data.augmentation.sampling import Sampling
from cfr_jax.runtime.fields import check_types
from cfr_jax.training.step import PRECISIONS

Range = tuple[float, float]
PLACES = ("host", "device")


@dataclass(slots=True)
class DataSection:
    """Where pairs come from: a corpus file in the layout of ModelNet40, or sources by name.

    Sources look like `{"street": {"kind": "kitti", "path": ..., "repeat": 4}, ...}`. `data.mixture`
    explains the kinds and checks the settings of each.
    """

    # typed as `object`, so that flags accept a path or a Python literal
    train: object = "data/open_cad/train.h5"  # `cfr data open-cad --out data/open_cad` makes it
    validation: object = "data/open_cad/val.h5"

    def __post_init__(self) -> None:
        for each in dataclasses.fields(self):
            given = getattr(self, each.name)
            if not isinstance(given, str | dict):
                raise ValueError(
                    f"data.{each.name}: got {given!r}, wanted a path, or sources by name"
                )


@dataclass(slots=True)
class SamplingSection:
    """How training pairs are drawn.

    These are fields of `data.augmentation.sampling.Sampling`, which explains and checks them. A
    "share of pairs" says how often something happens to a pair.
    """

    keep: Range = (0.55, 0.85)  # share of points that each crop keeps; the test protocol has 0.7
    angle: float = Sampling.angle  # degrees, per Euler angle
    translation: float = Sampling.translation
    both_ways: float = 0.5  # share of pairs with angles from [-angle, angle], not [0, angle]
    near: float = 0.3  # share of pairs with smaller motions, as a second cascade sees them
    centered: float = 0.4  # share of pairs with each cloud about its own centroid, as in `align`
    any_orientation: float = 0.3  # share of shapes; the rest stand upright, as CAD models do
    scale: Range = (0.8, 1.2)
    uneven: float = 0.0  # share of pairs with clouds that are denser on one side
    density: Range = Sampling.density  # how many times denser
    outliers: Range = Sampling.outliers  # share of points
    noise: Range = Sampling.noise  # per axis
    sensor_noise: float = 0.0  # share of pairs with noise along a depth sensor's rays instead
    sensor_scale: Range = Sampling.sensor_scale  # standard deviation at the middle of the cloud
    estimated_normals: float = 0.4  # share of pairs; users' clouds rarely have exact normals
    copied: bool = Sampling.copied  # make both clouds from the same points of the shape

    def __post_init__(self) -> None:
        check_types(self, "sampling.")

    @classmethod
    def plain(cls, **given: Any) -> "SamplingSection":
        """What protocols have: no augmentation beside motion, crop and noise."""
        return cls(
            both_ways=0.0,
            near=0.0,
            centered=0.0,
            any_orientation=0.0,
            scale=(1.0, 1.0),
            estimated_normals=0.0,
            **given,
        )


@dataclass(slots=True)
class Phase:
    """A phase of the curriculum."""

    steps: int
    points: int  # per cloud
    neighbors: int  # per point
    batch: int  # pairs per step, on all devices together
    sampling: dict[str, Any] = field(default_factory=dict)
    """Fields of `SamplingSection` that differ in this phase."""

    def __post_init__(self) -> None:
        check_types(self, "phases: ")
        if self.steps < 0 or self.batch < 1:
            raise ValueError(
                f"phases: got {self.steps} steps of {self.batch} pairs, wanted 0 or more steps of "
                "at least 1 pair"
            )
        known = [each.name for each in dataclasses.fields(SamplingSection)]
        if unknown := sorted(self.sampling.keys() - known):
            raise ValueError(
                f"phases: sampling: got {', '.join(unknown)}, wanted some of {', '.join(known)}"
            )


@dataclass(slots=True)
class TrainSection:
    """Loss, optimizer, and how a step is computed."""

    optimizer: str = "adamw"  # one of `optimizers.OPTIMIZERS`
    schedule: str = "cosine"  # one of `optimizers.SCHEDULES`, explained in `make_schedule`
    peak_rate: float = 1e-3
    warmup: float = 0.1  # share of all steps
    cooldown: float = 0.2  # share of all steps; only for "wsd" and "trapezoid"
    drops: tuple[float, ...] = ()  # shares of all steps after which the rate drops; for "stairs"
    drop_factor: float = 0.1  # what a drop multiplies the rate by
    clip: float = 1.0  # largest norm of the whole gradient
    weight_decay: float = 1e-5
    correspondence_weight: float = 0.05  # weight of the correspondence loss; the pose has 1
    average_decay: float = 0.999  # decay of the averaged weights, which are validated and kept
    # Precision of the products in learned layers: "float32"; "tensorfloat32", on a GPU; or
    # "bfloat16", which also stores the activations of CFR's heavy extraction in bfloat16. Geometry
    # stays float32.
    precision: str = "float32"
    pairs_at_once: int = 1  # vectorized pairs per device; on an accelerator, as many as fit
    max_skipped: int = 20  # steps in a row that may lack a finite gradient; after more, it stops
    draw: str = "host"  # where pairs are drawn: "host", or "device" for pairs of shapes
    workers: int = 1  # how many draw pairs on the host: threads; from five on, processes
    steps_at_once: int = 1  # steps per program, if the device draws
    minutes: float = 0.0  # length in wall-clock time, for a single phase; 0: by the phase's steps
    start_from: str = ""  # weights to start from, by name or path; "": random weights

    def __post_init__(self) -> None:
        check_types(self, "train.")
        _check_least(self, 1, "workers", "steps_at_once")
        _check_least(self, 0, "max_skipped", "minutes")
        for name, known in (("precision", PRECISIONS), ("draw", PLACES)):
            if getattr(self, name) not in known:
                raise ValueError(
                    f"{name}: got {getattr(self, name)!r}, wanted one of {', '.join(known)}"
                )


@dataclass(slots=True)
class TrainingConfig:
    """Everything that `train.py` reads. A section may be given as a dict of its fields."""

    seed: int = 0
    network: str = "cfr"  # a name in `networks.table`
    iterations: int = 5
    shared: bool = False  # one light layer for all iterations, instead of one for each
    width: int = 0  # channels of the features of DCP and RGM; 0: as published
    version: str = ""  # "v1" or "v2", for DCP
    settings: dict[str, Any] = field(default_factory=dict)
    """Settings of the network that differ from its usual ones; for CFR, fields of
    `networks.inputs.Settings`."""
    data: DataSection = field(default_factory=DataSection)
    # Clouds grow during training: at first, small clouds teach the most per second, and the shapes
    # of the weights depend neither on points nor on neighbors (docs/notes/training.md).
    phases: tuple[Phase, ...] = field(
        default_factory=lambda: (
            Phase(steps=3000, points=256, neighbors=24, batch=8),
            Phase(steps=4000, points=717, neighbors=32, batch=8),
        )
    )
    sampling: SamplingSection = field(default_factory=SamplingSection)
    train: TrainSection = field(default_factory=TrainSection)
    log_every: int = 50  # steps
    checkpoint_every: int = 250  # steps
    validate_every: int = 500  # steps
    # all of val.h5: with 96 pairs, two flipped shapes decided which weights were best
    validation_pairs: int = 465
    keep_checkpoints: int = 2  # how many of the last ones; the best is kept as well
    float16: bool = False  # large tensors of weights.safetensors, which is then half as large

    def __post_init__(self) -> None:
        # sections are made again, which checks the values that flags have set since
        self.data = _made(DataSection, self.data, "data")
        self.sampling = _made(SamplingSection, self.sampling, "sampling")
        self.train = _made(TrainSection, self.train, "train")
        if isinstance(self.phases, tuple):
            self.phases = tuple(_made(Phase, phase, "phases") for phase in self.phases)
        check_types(self)
        _check_least(self, 1, "log_every", "checkpoint_every", "validate_every")
        _check_least(self, 1, "validation_pairs", "keep_checkpoints")
        for phase in self.phases:
            self.sampling_of(phase, Sampling.radius)
        _check_length(self.train, self.phases)

    def sampling_of(self, phase: Phase, radius: float) -> Sampling:
        """How the pairs of a phase are drawn, with neighbors within the network's `radius`.

        Raises a ValueError that names the field for values that cannot be used.
        """
        given = dataclasses.asdict(self.sampling) | phase.sampling
        return Sampling(points=phase.points, neighbors=phase.neighbors, radius=radius, **given)


def checked(config: object) -> TrainingConfig:
    """A copy of a config, with every value checked.

    Raises a ValueError that names the field for a value that cannot be used.
    """
    if not isinstance(config, TrainingConfig):
        raise ValueError(
            f"config: got {type(config).__name__}, wanted TrainingConfig "
            "(cfr_jax/training/config.py; configs/ has examples)"
        )
    return dataclasses.replace(config)


def _check_length(train: TrainSection, phases: tuple[Phase, ...]) -> None:
    if train.draw == "host" and (train.steps_at_once > 1 or train.minutes):
        raise ValueError(
            f"steps_at_once, minutes: got {train.steps_at_once} and {train.minutes}, wanted 1 and "
            '0, because train.draw is "host"; train.draw="device" allows other values'
        )
    if train.minutes and (len(phases) > 1 or train.schedule not in ("trapezoid", "stairs")):
        raise ValueError(
            f"minutes: got {train.minutes} for {len(phases)} phases and schedule "
            f"{train.schedule!r}, wanted one phase (its steps follow from the time) and "
            "'trapezoid' or 'stairs'"
        )
    rests = [phase.steps for phase in phases if phase.steps % train.steps_at_once]
    if rests and not train.minutes:
        raise ValueError(
            f"steps_at_once: got {train.steps_at_once}, wanted a divisor of the {rests[0]} steps "
            "of a phase: a remainder would be compiled separately"
        )


def _made(kind: Any, given: Any, name: str) -> Any:
    if isinstance(given, kind):
        return dataclasses.replace(given)
    if not isinstance(given, dict):
        raise ValueError(f"{name}: got {given!r}, wanted {kind.__name__} or a dict of its fields")
    try:
        return kind(**given)
    except TypeError as error:  # its text names the unknown or missing field
        raise ValueError(f"{name}: {error}") from error


def _check_least(section: Any, least: int, *names: str) -> None:
    for name in names:
        if getattr(section, name) < least:
            raise ValueError(f"{name}: got {getattr(section, name)}, wanted at least {least}")
