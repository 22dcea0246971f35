"""A pair made ready on the host: read, checked, centered, scaled and thinned."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from numbers import Integral
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from cfr_jax.alignment import starts
from cfr_jax.geometry import motions, plausible, units
from cfr_jax.io import PointCloud, as_point_cloud
from cfr_jax.networks.inputs import Settings, refuse_masked

DEFAULT_BUDGET = 1024
SETTINGS = Settings()
_SAMPLED = 2048  # points that show whether many come again and again
CASCADES = 2  # chosen on validation pairs (docs/training.md)


Initial = Float[np.ndarray, "4 4"] | Float[np.ndarray, "k 4 4"] | Literal["global", "auto"] | None


@dataclass(frozen=True, eq=False)
class Plan:
    """A pair made ready for the device."""

    frames: units.Frames
    source: units.UnitCloud
    target: units.UnitCloud
    seed: int = 0
    start_given: bool = False
    """Whether somebody said where the source starts; else centroid lies on centroid."""
    if_doubted: bool = False
    """Whether `starts` are tried only where the answer from the one start is not trusted."""
    starts: Float[np.ndarray, "s 4 4"] | None = None
    """Motions of unit clouds to start from, of which a search takes the best; None where the one
    start that there is has been made part of `frames`."""
    whole: tuple[PointCloud, PointCloud] | None = None
    """The caller's clouds with all their points, where they are asked for."""
    remarks: tuple[str, ...] = ()
    """What was done differently when the clouds were made ready, in words."""

    @property
    def thinned(self) -> bool:
        """Whether one of the `whole` clouds has points that the network does not see."""
        sides = zip(self.whole or (), (self.source, self.target), strict=False)
        return any(len(cloud.points) > len(unit.rows) for cloud, unit in sides)

    def started_at(self, motion: Float[np.ndarray, "4 4"]) -> Plan:
        """The same clouds, the source moved by `motion` of unit clouds first."""
        points = motions.apply(motion, self.source.points).astype(np.float32)
        points *= self.source.mask[:, None]
        normals = self.source.normals
        moved = dataclasses.replace(
            self.source,
            points=points,
            normals=None if normals is None else motions.rotate(motion, normals).astype(np.float32),
        )
        frames = dataclasses.replace(
            self.frames,
            source_center=self.frames.target_center,
            initial=self.frames.to_caller(motion),
        )
        return dataclasses.replace(self, frames=frames, source=moved, start_given=True, starts=None)


def read_clouds(source: Any, target: Any) -> tuple[PointCloud, PointCloud]:
    """Both as clouds; raises ValueError, by name, for what is none or has too few points."""
    for cloud, name in ((source, "source"), (target, "target")):
        refuse_masked(name, cloud, "leave their rows out")
    clouds = as_point_cloud(source, name="source"), as_point_cloud(target, name="target")
    for cloud, name in zip(clouds, ("source", "target"), strict=True):
        if len(cloud.points) < 3:
            raise ValueError(f"{name}: got {len(cloud.points)} points, wanted at least 3")
    return clouds


def planned(
    source: Any,
    target: Any,
    *,
    initial: Initial = None,
    max_points: int | None = None,
    seed: int = 0,
    whole: bool = False,
    search: bool = True,
    settings: Settings = SETTINGS,
    to_unit: Callable[..., units.UnitCloud] = units.to_unit,
) -> Plan:
    """Reads, centers, scales and thins a pair; arguments and errors are those of `align`.

    The plan keeps the `whole` clouds on demand. Without `search` it leaves the search for
    neighbors to the device. `to_unit` may stand in for `units.to_unit`, and remember what it made.
    """
    (source, target), remarks = _without_wrong_normals(read_clouds(source, target))
    everywhere = isinstance(initial, str) and initial in ("global", "auto")
    given = None if initial is None or everywhere else rigid_motions(initial)
    start = given[0] if given is not None and len(given) == 1 else None
    budget = DEFAULT_BUDGET
    if max_points is not None:
        budget = whole_number("max_points", max_points, least=3)
    seed = whole_number("seed", seed, least=0)
    frames = units.unit_frames(source, target, start)
    several = None
    if everywhere:
        several = starts.everywhere()
    elif given is not None and start is None:
        several = starts.given(frames, given)
    unit_source, unit_target = (
        to_unit(
            cloud,
            center,
            frames.scale,
            motion,
            budget=budget,
            neighbors=settings.neighbors,
            radius=settings.radius,
            seed=seed,
            search=search,
        )
        for cloud, center, motion in (
            (source, frames.source_center, frames.initial),
            (target, frames.target_center, np.eye(4)),
        )
    )
    remarks += _strays_in_words(frames, source, target)
    return Plan(
        frames,
        unit_source,
        unit_target,
        seed,
        start_given=given is not None,
        if_doubted=everywhere and initial == "auto",
        starts=several,
        whole=(_each_place_once(source), _each_place_once(target)) if whole else None,
        remarks=remarks,
    )


def _without_wrong_normals(
    clouds: tuple[PointCloud, PointCloud],
) -> tuple[tuple[PointCloud, PointCloud], tuple[str, ...]]:
    """The clouds, without normals that contradict their points, and what is to be said of it."""
    kept, remarks = [], []
    for cloud, name in zip(clouds, ("source", "target"), strict=True):
        if cloud.normals is not None and plausible.contradict(cloud.points, cloud.normals):
            cloud = dataclasses.replace(cloud, normals=None)
            remarks.append(
                f"the normals of the {name} contradict its points (placeholders, colors?): "
                "estimated from the points instead"
            )
        kept.append(cloud)
    return (kept[0], kept[1]), tuple(remarks)


def _each_place_once(cloud: PointCloud) -> PointCloud:
    """A cloud in which many points come again and again, with each of them once; else itself."""
    rows = np.random.default_rng(0).permutation(len(cloud.points))[:_SAMPLED]
    if not units.repeated(cloud.points[rows]):
        return cloud
    rows = units.first_of_each_place(cloud.points)
    normals = None if cloud.normals is None else cloud.normals[rows]
    return dataclasses.replace(cloud, points=cloud.points[rows], normals=normals)


def _strays_in_words(frames: units.Frames, *clouds: PointCloud) -> tuple[str, ...]:
    return tuple(
        f"{count} of the {len(cloud.points)} points of the {name} lie far out and are not used: "
        "more than four radii of the others"
        for count, cloud, name in zip(frames.strays, clouds, ("source", "target"), strict=True)
        if count
    )


def whole_number(name: str, value: Any, *, least: int) -> int:
    """`value` if it is a whole number of at least `least`; else a ValueError with the name."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        raise ValueError(f"{name}: got {value!r}, wanted a whole number of at least {least}")
    return int(value)


def rigid_motions(initial: Any) -> Float[np.ndarray, "k 4 4"]:
    """One or several initial motions, float64; raises ValueError for anything else."""
    try:
        given = np.asarray(initial)
        if given.dtype.kind in "cOSUmM":  # numpy would make floats of complex numbers and texts
            raise TypeError
        given = given.astype(np.float64)
    except (TypeError, ValueError, OverflowError):
        what = repr(initial) if isinstance(initial, str) else f"a {type(initial).__name__}"
        raise ValueError(
            f"initial: got {what} that is no array of numbers, "
            'wanted "global", "auto", a (4, 4) matrix, or several as (k, 4, 4)'
        ) from None
    if given.ndim not in (2, 3) or given.shape[-2:] != (4, 4) or not given.size:
        raise ValueError(f"initial: got shape {given.shape}, wanted (4, 4) or (k, 4, 4)")
    return motions.check_rigid("initial", given, several=True).reshape(-1, 4, 4)
