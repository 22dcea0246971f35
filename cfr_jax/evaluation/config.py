"""The config of an evaluation: every field with its default, and its unit or the reason for it.

A file in `configs/` states the data, the methods, and what differs from these defaults. Flags of
`evaluate.py` set single fields (`--config.data.protocol=clean`), one after the other, according to
the types given here. `checked` then checks the whole config.
"""

# No `from __future__ import annotations`: ml_collections reads the types of the fields.
import copy
import dataclasses
from dataclasses import dataclass, field
from typing import Any

from cfr_jax.runtime.fields import check_types

Threshold = tuple[float, float]
"""Degrees, and a length in the data's unit."""


@dataclass(slots=True)
class MethodEntry:
    """A row of the table: a method, and how to run it."""

    use: str  # a name in `baselines.NAMES`, "truth", or a network in `networks.table`
    options: dict[str, Any] = field(default_factory=dict)  # arguments of the method, by name
    weights: str = ""  # weights of a network, by name or path; "": those of the config
    threads: int | None = None  # cores of its process; None: as many as the config says
    batch: int = 1  # pairs per call, for networks
    estimated_normals: bool = False  # estimate normals even if the pairs have exact ones
    modules: bool = False  # also time the parts of a network

    def __post_init__(self) -> None:
        check_types(self, "methods: ")
        if self.batch < 1:
            raise ValueError(f"methods: batch: got {self.batch}, wanted at least 1 pair")
        # configs pass the same options to several methods, but a flag sets those of only one
        self.options = copy.deepcopy(self.options)


@dataclass(slots=True)
class EvaluationConfig:
    """Everything that `evaluate.py` reads."""

    title: str
    data: dict[str, Any]
    """`kind` (one of `data.kinds`, or "auto" to recognize it by its layout), `path`, and the
    settings that the `evaluate` of this kind takes."""
    methods: dict[str, MethodEntry]
    limit: int = 0  # how many pairs, from the first; 0 for all
    seed: int = 0  # for methods that draw random numbers, and for the intervals
    weights: str = "object"  # weights of CFR, by name or path
    rpmnet_weights: str = "rpmnet"  # by name or path; without them RPM-Net is left out
    threads: int = 2  # cores of each method's process; 0 for all
    timeout: float = 60.0  # seconds per pair
    unit: str = ""  # unit of lengths; "" for radii of the unit sphere
    thresholds: tuple[Threshold, ...] = ((1.0, 0.02), (1.0, 0.1), (5.0, 0.1))  # for recalls
    main_threshold: Threshold = (5.0, 0.1)  # for plots
    limits: Threshold = (15.0, 0.3)  # ends of the axes in the recall plots

    def __post_init__(self) -> None:
        check_types(self)
        for name, entry in self.methods.items():
            if not isinstance(entry, MethodEntry):
                raise ValueError(f"methods.{name}: got {entry!r}, wanted a MethodEntry")
        self.methods = {name: dataclasses.replace(each) for name, each in self.methods.items()}
        for name in ("limit", "threads", "timeout"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name}: got {getattr(self, name)}, wanted 0 or more")
        for name in ("thresholds", "main_threshold", "limits"):
            given = getattr(self, name)
            for pair in given if name == "thresholds" else (given,):
                if not (isinstance(pair, tuple) and len(pair) == 2 and min(pair) > 0):
                    raise ValueError(f"{name}: got {pair!r}, wanted degrees and a length")


def checked(config: object) -> EvaluationConfig:
    """A copy of a config, with every value checked.

    Raises a ValueError that names the field for a value that cannot be used.
    """
    if not isinstance(config, EvaluationConfig):
        raise ValueError(
            f"config: got {type(config).__name__}, wanted EvaluationConfig "
            "(cfr_jax/evaluation/config.py; configs/eval_* are examples)"
        )
    return dataclasses.replace(config)
