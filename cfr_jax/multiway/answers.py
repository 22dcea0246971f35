"""What `merge` answers: the poses, how sure each is, the edges they rest on, and the cloud."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from cfr_jax.io import PointCloud
from cfr_jax.multiway.scans import LeftOut


@dataclass(frozen=True, eq=False)
class Edge:
    """A pair of scans that was registered."""

    source: int
    """Index of the scan that was moved."""
    target: int
    transform: Float[np.ndarray, "4 4"]
    """What the registration found: maps the source onto the target, in the caller's frames."""
    confidence: float | None
    """Of the registration, as in `Alignment`."""
    kept: bool
    """Whether the poses agree with it. Wrong edges are those that are not kept."""
    residual: float
    """By how much the poses disagree: how far they move the source's points from where the edge
    lays them, on average, in the caller's unit. NaN between scans of different components."""
    distance: float
    """Root mean square distance of the two scans' points to each other's planes under the final
    poses. NaN between scans of different components, and where they do not touch."""
    reason: str
    """Why it is not kept; empty if it is."""


@dataclass(frozen=True, eq=False)
class Fused:
    """A merged cloud."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    """Unit normals: the mean of the scans' own, or estimated, pointing away from the centroid."""
    scan: Int[np.ndarray, " n"]
    """Index of the scan that gave most to each point."""
    count: Int[np.ndarray, " n"]
    """How many points each is the mean of."""
    voxel: float

    def as_cloud(self, name: str = "model") -> PointCloud:
        """Points and normals, as `io.write` takes them."""
        return PointCloud(self.points, self.normals, name)


@dataclass(frozen=True, eq=False)
class Merged:
    """Answer of `merge`; everything in the caller's units."""

    names: tuple[str, ...]
    """Of all scans, in the order in which they came."""
    placed: Int[np.ndarray, " p"]
    """Indices of the scans that have a pose, ascending."""
    poses: Float[np.ndarray, "p 4 4"]
    """Of each placed scan: maps it into the frame of the reference of its component. Float64."""
    covariances: Float[np.ndarray, "p 6 6"]
    """Of each pose: of the twist (rotation in radians, then translation, in the frame of the scan
    and about its centroid) by which it is off. Zero for a reference."""
    component: Int[np.ndarray, " p"]
    """Which model each scan belongs to; 0 is the one with the most scans."""
    references: tuple[int, ...]
    """Index of the scan whose frame is that of the model, for each component."""
    edges: tuple[Edge, ...]
    left_out: tuple[LeftOut, ...]
    """Scans without a pose, and why. They are in no cloud."""
    notes: tuple[str, ...]
    """What else a reader should know: scans that came twice, parts that stayed apart."""
    clouds: tuple[Fused, ...]
    """The merged cloud of each component; empty if `merge` was asked for poses only."""
    seconds: dict[str, float]
    """`read`, `register`, `place`, `refine`, `fuse`, and `total`."""

    def pose(self, scan: int | str) -> Float[np.ndarray, "4 4"]:
        """The pose of a scan, by index or name. Raises KeyError for one that has none."""
        index = scan
        if isinstance(scan, str):
            index = self.names.index(scan) if scan in self.names else -1
        for row in np.flatnonzero(self.placed == index):
            return self.poses[row]
        raise KeyError(f"scan {scan!r} has no pose")

    def by_component(self) -> Iterator[tuple[int, Int[np.ndarray, " k"]]]:
        """Each component, with the rows of its scans in `placed` and `poses`."""
        for number in range(len(self.references)):
            yield number, np.flatnonzero(self.component == number)
