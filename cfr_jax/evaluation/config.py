"""What an evaluation is told: every field with its default, and its unit or its reason.

A file in `configs/` states the data, the methods, and what differs from these defaults.
`evaluate.py` sets fields by flags (`--config.data.protocol=clean`), one after the other and by the
types written here; `checked` then looks at the whole.
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
    """A method of the table, and how it is run."""

    use: str  # a name of `baselines.NAMES`, "truth", or a network of `networks.table`
    options: dict[str, Any] = field(default_factory=dict)  # what it takes, by name
    weights: str = ""  # of a network, instead of the config's; by name or path
    threads: int | None = None  # cores of its process; None: the config's
    batch: int = 1  # pairs a call, of networks
    estimated_normals: bool = False  # even where the pairs have exact ones
    modules: bool = False  # whether to time the parts of a network, too

    def __post_init__(self) -> None:
        check_types(self, "methods: ")
        if self.batch < 1:
            raise ValueError(f"methods: batch: got {self.batch}, wanted at least 1 pair")
        # configs hand the same options to several methods, but a flag sets those of one
        self.options = copy.deepcopy(self.options)


@dataclass(slots=True)
class EvaluationConfig:
    """All that `evaluate.py` reads."""

    title: str
    data: dict[str, Any]
    """`kind` (one of `data.kinds`, or "auto": told from the layout), `path`, and the settings of
    that kind: those that its `evaluate` takes."""
    methods: dict[str, MethodEntry]
    limit: int = 0  # pairs, from the first; 0 for all
    seed: int = 0  # of the methods that draw, and of the intervals
    weights: str = "object"  # of CFR; by name or path
    rpmnet_weights: str = "rpmnet"  # RPM-Net is left out where there are none
    threads: int = 2  # cores of each method's process; 0 for all
    timeout: float = 60.0  # seconds a pair
    unit: str = ""  # of lengths; "" for the unit sphere
    thresholds: tuple[Threshold, ...] = ((1.0, 0.02), (1.0, 0.1), (5.0, 0.1))  # of the recalls
    main_threshold: Threshold = (5.0, 0.1)  # of the plots
    limits: Threshold = (15.0, 0.3)  # where the axes of the recall plots end

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
    """A copy of a config, every value of which was checked.

    Raises ValueError, naming the field, for a value that cannot be used.
    """
    if not isinstance(config, EvaluationConfig):
        raise ValueError(
            f"config: got {type(config).__name__}, wanted EvaluationConfig "
            "(cfr_jax/evaluation/config.py; configs/eval_* are examples)"
        )
    return dataclasses.replace(config)
