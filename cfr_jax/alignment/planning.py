"""Prepares a pair on the host: reads, checks, centers, scales and thins its clouds."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from numbers import Integral
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from cfr_jax.alignment import starts
from cfr_jax.geometry import motions, plausible, thinning, units
from cfr_jax.geometry.trees import Tree
from cfr_jax.io import PointCloud, as_point_cloud
from cfr_jax.networks.inputs import Settings, refuse_masked

DEFAULT_BUDGET = 1024
SETTINGS = Settings()
_SAMPLED = 2048  # points that are looked at to find out whether many are repeated
SIZES_APART = 5.0  # partial views of one thing never differ in radius by as much as this
CASCADES = 2  # chosen on validation pairs (docs/training.md)

# What the option `initial` of `align` takes.
Initial = Float[np.ndarray, "4 4"] | Float[np.ndarray, "k 4 4"] | Literal["global", "auto"] | None


@dataclass(frozen=True, eq=False)
class Plan:
    """A pair that is ready for the device."""

    frames: units.Frames
    source: units.UnitCloud
    target: units.UnitCloud
    seed: int = 0
    start_given: bool = False
    """Whether the caller or a search chose the start. Otherwise the centroids are laid on each
    other."""
    if_doubted: bool = False
    """Whether `starts` are tried only if the answer from the single start is not trusted."""
    starts: Float[np.ndarray, "s 4 4"] | None = None
    """Motions of unit clouds to start from. A search takes the best of them. None if there is a
    single start, which is then part of `frames`."""
    whole: tuple[PointCloud, PointCloud] | None = None
    """The caller's clouds with all their points, if a refinement needs them."""
    remarks: tuple[str, ...] = ()
    """Sentences that say what was done differently when the clouds were prepared."""
    spacing_ratio: float | None = None
    """The distance between neighboring points of the source, divided by that of the target. Only
    known where the sizes of the clouds differ much."""
    scale: float = 1.0
    """What the points of the caller's source were multiplied by."""
    scale_confidence: float | None = None
    """How likely that factor is right, if it was estimated."""

    @property
    def thinned(self) -> bool:
        """Whether one of the `whole` clouds has points that the network does not see."""
        sides = zip(self.whole or (), (self.source, self.target), strict=False)
        return any(len(cloud.points) > len(unit.rows) for cloud, unit in sides)

    def started_at(self, motion: Float[np.ndarray, "4 4"]) -> Plan:
        """The plan for the same clouds with the source first moved by `motion`, a motion between
        the unit clouds."""
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
    """Reads both as point clouds. Raises ValueError, with the argument's name, for anything that is
    not a point cloud or has fewer than 3 points."""
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
    """Reads, centers, scales and thins a pair. Arguments and errors are those of `align`.

    With `whole`, the plan also keeps the clouds with all their points. With `search=False`, it
    leaves the search for neighbors to the device. A caller can replace `units.to_unit` with a
    `to_unit` of its own, for example one that remembers its results.
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
        spacing_ratio=_spacing_ratio(frames, source, target),
    )


def _spacing_ratio(frames: units.Frames, source: PointCloud, target: PointCloud) -> float | None:
    if 1 / SIZES_APART <= frames.size_ratio <= SIZES_APART:
        return None
    ours, theirs = Tree(source.points).spacing, Tree(target.points).spacing
    return ours / theirs if ours > 0 and theirs > 0 else None


def _without_wrong_normals(
    clouds: tuple[PointCloud, PointCloud],
) -> tuple[tuple[PointCloud, PointCloud], tuple[str, ...]]:
    """The clouds, with normals removed where they contradict the points, and remarks that say
    so."""
    kept, remarks = [], []
    for cloud, name in zip(clouds, ("source", "target"), strict=True):
        if cloud.normals is not None and plausible.contradict(cloud.points, cloud.normals):
            cloud = dataclasses.replace(cloud, normals=None)
            remarks.append(
                f"the normals of the {name} contradict its points (placeholders, colors?): "
                "they were estimated from the points instead"
            )
        kept.append(cloud)
    return (kept[0], kept[1]), tuple(remarks)


def _each_place_once(cloud: PointCloud) -> PointCloud:
    """The cloud with each place kept once, if many of its points are repeated. Otherwise the cloud
    itself."""
    rows = np.random.default_rng(0).permutation(len(cloud.points))[:_SAMPLED]
    if not thinning.repeated(cloud.points[rows]):
        return cloud
    rows = thinning.first_of_each_place(cloud.points)
    normals = None if cloud.normals is None else cloud.normals[rows]
    return dataclasses.replace(cloud, points=cloud.points[rows], normals=normals)


def _strays_in_words(frames: units.Frames, *clouds: PointCloud) -> tuple[str, ...]:
    return tuple(
        f"{count} of the {len(cloud.points)} points of the {name} lie far out and are not used: "
        "they are more than four radii from the center of the others"
        for count, cloud, name in zip(frames.strays, clouds, ("source", "target"), strict=True)
        if count
    )


def whole_number(name: str, value: Any, *, least: int) -> int:
    """Returns `value` as an int. Raises ValueError, with the argument's name, if it is not a whole
    number of at least `least`."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        raise ValueError(f"{name}: got {value!r}, wanted a whole number of at least {least}")
    return int(value)


def rigid_motions(initial: Any) -> Float[np.ndarray, "k 4 4"]:
    """Returns one or several initial motions as (k, 4, 4) in float64. Raises ValueError for
    anything else."""
    try:
        given = np.asarray(initial)
        if given.dtype.kind in "cOSUmM":  # numpy would turn complex numbers and text into floats
            raise TypeError
        given = given.astype(np.float64)
    except (TypeError, ValueError, OverflowError):
        what = repr(initial) if isinstance(initial, str) else f"a {type(initial).__name__}"
        raise ValueError(
            f"initial: got {what}, which is not an array of numbers; "
            'wanted "global", "auto", a (4, 4) matrix, or several as (k, 4, 4)'
        ) from None
    if given.ndim not in (2, 3) or given.shape[-2:] != (4, 4) or not given.size:
        raise ValueError(f"initial: got shape {given.shape}, wanted (4, 4) or (k, 4, 4)")
    return motions.check_rigid("initial", given, several=True).reshape(-1, 4, 4)
