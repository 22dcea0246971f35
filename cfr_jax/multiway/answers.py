"""The answer of `merge`: poses, their covariances, the edges behind them, and the merged cloud."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from cfr_jax.io import PointCloud
from cfr_jax.multiway.scans import LeftOut
from cfr_jax.runtime.values import ByValue


@dataclass(frozen=True, eq=False)
class Edge(ByValue):
    """A pair of scans that was registered."""

    source: int
    """Index of the scan that was moved."""
    target: int
    transform: Float[np.ndarray, "4 4"]
    """The result of the registration: maps the source onto the target, in the caller's frames."""
    confidence: float | None
    """The confidence of the registration, as in `Alignment`."""
    kept: bool
    """Whether the poses agree with this edge. An edge that is not kept counts as wrong."""
    residual: float
    """How much the poses disagree with this edge: the mean distance between the places where the
    poses and the edge put the source's points, in the caller's unit. NaN between scans of different
    components."""
    distance: float
    """The root mean square distance from the source's points to the target's planes under the final
    poses. NaN between scans of different components, and if the scans do not touch."""
    reason: str
    """Why the edge is not kept; empty if it is."""


@dataclass(frozen=True, eq=False)
class Fused(ByValue):
    """A merged cloud."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    """Unit normals: the mean of the scans' own normals, or estimated ones that point away from the
    centroid."""
    scan: Int[np.ndarray, " n"]
    """For each point, the index of the scan that contributed the most to it."""
    count: Int[np.ndarray, " n"]
    """The number of points of which each point is the mean."""
    voxel: float
    """The edge length of the cubes."""

    def as_cloud(self, name: str = "model") -> PointCloud:
        """The points and normals as a cloud that `io.write` accepts."""
        return PointCloud(self.points, self.normals, name)


@dataclass(frozen=True, eq=False)
class Merged(ByValue):
    """The answer of `merge`. Everything is in the caller's unit."""

    names: tuple[str, ...]
    """The names of all scans, in the order of the input."""
    placed: Int[np.ndarray, " p"]
    """The indices of the scans that have a pose, in ascending order."""
    poses: Float[np.ndarray, "p 4 4"]
    """The pose of each placed scan, which maps it into the frame of its component's reference.
    Float64."""
    covariances: Float[np.ndarray, "p 6 6"]
    """The covariance of each pose: of the twist by which the pose is off. The twist has the
    rotation in radians first, then the translation, in the frame of the scan and about its
    centroid. Zero for a reference."""
    component: Int[np.ndarray, " p"]
    """The model that each placed scan belongs to. Model 0 has the most scans."""
    references: tuple[int, ...]
    """For each component, the index of the scan whose frame is the frame of the model."""
    edges: tuple[Edge, ...]
    left_out: tuple[LeftOut, ...]
    """The scans without a pose, and why they have none. They are in no merged cloud."""
    notes: tuple[str, ...]
    """Remarks for the reader: scans that were given twice, parts that nothing connects."""
    clouds: tuple[Fused, ...]
    """The merged cloud of each component; empty if only poses were wanted."""
    seconds: dict[str, float]
    """`read`, `register`, `place`, `refine`, `fuse`, and `total`."""

    _not_compared = ("seconds",)

    def pose(self, scan: int | str) -> Float[np.ndarray, "4 4"]:
        """The pose of a scan, by its index or name. Raises KeyError if it has none."""
        index = scan
        if isinstance(scan, str):
            index = self.names.index(scan) if scan in self.names else -1
        for row in np.flatnonzero(self.placed == index):
            return self.poses[row]
        raise KeyError(f"scan {scan!r} has no pose")

    def by_component(self) -> Iterator[tuple[int, Int[np.ndarray, " k"]]]:
        """Yields each component's number, with the rows of its scans in `placed` and `poses`."""
        for number in range(len(self.references)):
            yield number, np.flatnonzero(self.component == number)
