"""The config of an evaluation of merges: every field with its default."""

# No `from __future__ import annotations`: ml_collections reads the types of the fields.
from dataclasses import dataclass
from typing import Any

from cfr_jax.runtime.fields import check_types


@dataclass(slots=True)
class MergeConfig:
    """Everything that `evaluate.py` reads of it."""

    title: str
    data: dict[str, Any]
    """`kind`: "views" (`path`: folders of scans, each with a `poses.json`) or "kitti" (`path` and
    `sequence`: frames and poses of an odometry sequence)."""
    methods: tuple[str, ...] = ("merge", "chain", "open3d")
    ordered: bool = False  # whether the order of the scans says which overlap
    threshold: tuple[float, float] = (3.0, 0.03)  # degrees and a length: a pose that is right
    wrong_edge: tuple[float, float] = (10.0, 0.15)  # the same for an edge that is wrong
    limit: int = 0  # how many sets, or frames of a sequence, from the first; 0 for all
    seed: int = 0
    weights: str = "object"  # by name or path
    unit: str = ""  # of lengths; "" for radii of the unit sphere

    def __post_init__(self) -> None:
        check_types(self)
        if self.data.get("kind") not in ("views", "kitti"):
            raise ValueError(
                f"data: kind: got {self.data.get('kind')!r}, wanted 'views' or 'kitti'"
            )
        unknown = [name for name in self.methods if name not in ("merge", "chain", "open3d")]
        if unknown or not self.methods:
            raise ValueError(f"methods: got {self.methods}, wanted some of merge, chain, open3d")
        for name in ("threshold", "wrong_edge"):
            given = getattr(self, name)
            if len(given) != 2 or min(given) <= 0:
                raise ValueError(f"{name}: got {given!r}, wanted degrees and a length")
        if self.limit < 0:
            raise ValueError(f"limit: got {self.limit}, wanted 0 or more")
