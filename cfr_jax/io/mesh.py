"""Triangle meshes, on the way to the points sampled from them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64, Int64, Integer, Real

from cfr_jax.io.cloud import PointCloud, checked_points, usable_normals

if TYPE_CHECKING:
    from cfr_jax.io.table import Table

DEFAULT_SAMPLES = 10_000
_AT_ONCE = 1 << 16  # triangles, so that memory stays near what the mesh itself takes
# The corners of all polygons one after the other, or a row for each, and how many each one has.
Polygons = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Vertices (v, 3) and the triangles (t, 3) that index them, counter-clockwise outside."""

    vertices: Real[np.ndarray, "v 3"]
    triangles: Int64[np.ndarray, "t 3"]
    name: str
    normals: Real[np.ndarray, "v 3"] | None = None
    notes: tuple[str, ...] = ()
    table: Table | None = None

    def points(self, samples: int | None, seed: int) -> PointCloud:
        """The surface as `samples` points, 10,000 if None; the bare vertices if 0."""
        if samples == 0:
            normals = None if self.normals is None else usable_normals(self.normals)
            return PointCloud(self.vertices, normals, self.name, notes=self.notes, table=self.table)
        if len(self.triangles) == 0:
            raise ValueError(
                f"is a mesh without faces ({len(self.vertices)} vertices), wanted at least one "
                "face; samples=0 takes the vertices as the cloud"
            )
        return self._sample(DEFAULT_SAMPLES if samples is None else samples, seed)

    def _sample(self, count: int, seed: int) -> PointCloud:
        """Points uniform over the surface's area, each with its triangle's normal."""
        vertices = checked_points(self.vertices)
        areas = np.empty(len(self.triangles))
        for start in range(0, len(areas), _AT_ONCE):
            named = self.triangles[start : start + _AT_ONCE]
            outside = (named < 0) | (named >= len(vertices))
            if outside.any():
                triangle, corner = np.argwhere(outside)[0]
                raise ValueError(
                    f"triangle {start + triangle} names vertex {named[triangle, corner]}, "
                    f"wanted 0 to {len(vertices) - 1}"
                )
            areas[start : start + len(named)] = areas_and_normals(vertices[named])[0]
        generator = np.random.default_rng(seed)
        chosen = _chosen_by_area(areas, count, generator)
        corners = vertices[self.triangles[chosen]]
        points, normals = _points_within(corners, generator), areas_and_normals(corners)[1]
        return PointCloud(points, normals, self.name, notes=self.notes, table=self.table)


def sample_triangles(
    corners: Float64[np.ndarray, "t 3 3"], count: int, rng: np.random.Generator
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
    """Points uniform over the area, and the unit normals of the triangles they lie on.

    Raises ValueError where no triangle has an area.
    """
    areas, normals = areas_and_normals(corners)
    chosen = _chosen_by_area(areas, count, rng)
    return _points_within(corners[chosen], rng), normals[chosen]


def _chosen_by_area(
    areas: Float64[np.ndarray, " t"], count: int, rng: np.random.Generator
) -> Int64[np.ndarray, " n"]:
    """Triangles drawn as often as their area is large; `areas` become their sums."""
    cumulative = np.cumsum(areas, out=areas)
    if not cumulative[-1] > 0:
        raise ValueError(f"all {len(areas)} triangles have no area, wanted a surface")
    # side="right" never picks a triangle of zero area: its bound equals the one before
    draw = rng.uniform(0.0, cumulative[-1], count)
    return np.searchsorted(cumulative, draw, side="right")


def _points_within(
    corners: Float64[np.ndarray, "n 3 3"], rng: np.random.Generator
) -> Float64[np.ndarray, "n 3"]:
    """A point of each triangle, uniform over it."""
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    # The square root spreads evenly over a triangle what is drawn along its height.
    count = len(corners)
    along, across = np.sqrt(rng.uniform(size=(count, 1))), rng.uniform(size=(count, 1))
    return a + along * ((1 - across) * ab + across * ac)


def areas_and_normals(
    corners: Float64[np.ndarray, "t 3 3"],
) -> tuple[Float64[np.ndarray, " t"], Float64[np.ndarray, "t 3"]]:
    """Of each triangle; the unit normal points to where its corners run counter-clockwise."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double = np.linalg.norm(cross, axis=1)
    return double / 2, cross / np.where(double > 0, double, 1.0)[:, None]


def fan_triangles(
    values: Real[np.ndarray, " k"] | Real[np.ndarray, "f w"],
    sizes: Integer[np.ndarray, " f"],
    before: int = 0,
) -> Int64[np.ndarray, "t 3"]:
    """Polygons cut into triangles about their first corner.

    The first `sizes[0]` of the values are the corners of the first polygon, and so on. Polygons of
    fewer than three corners enclose nothing and give no triangle. Messages count triangles from
    `before`.
    """
    total = triangles_within(sizes)
    flat = values.ndim == 1
    triangles = np.empty((total, 3), np.int64)
    done = first = 0
    for start in range(0, len(sizes), _AT_ONCE):
        counts = sizes[start : start + _AT_ONCE].astype(np.int64)
        held = int(counts.sum())
        part = values[first : first + held] if flat else values[start : start + _AT_ONCE].ravel()
        first += held
        for corners in _fans(part, counts):
            # Text may hold anything; beyond 2^53 a float64 is no index, and NaN compares false.
            whole = ((np.abs(corners) < 2**53) & (corners % 1 == 0)).all(axis=1)
            if not whole.all():
                row = int(np.argmin(whole))
                raise ValueError(
                    f"triangle {before + done + row} names vertices {corners[row]}, wanted integers"
                )
            triangles[done : done + len(corners)] = corners
            done += len(corners)
    return triangles


def triangles_within(sizes: Integer[np.ndarray, " f"]) -> int:
    """How many triangles polygons of so many corners give."""
    starts = range(0, len(sizes), _AT_ONCE)
    return sum(
        int(np.maximum(sizes[start : start + _AT_ONCE].astype(np.int64) - 2, 0).sum())
        for start in starts
    )


def _fans(
    values: Real[np.ndarray, " k"], sizes: Int64[np.ndarray, " f"]
) -> Iterator[Real[np.ndarray, "t 3"]]:
    """The corners of the triangles of a block of polygons, a block of triangles at a time."""
    if (sizes == 3).all():
        yield values.reshape(-1, 3)
        return
    starts = np.cumsum(sizes) - sizes
    counts = np.maximum(sizes - 2, 0)
    ends = np.cumsum(counts)
    total = int(ends[-1]) if len(ends) else 0
    for start in range(0, total, _AT_ONCE):
        rows = np.arange(start, min(start + _AT_ONCE, total))
        polygon = np.searchsorted(ends, rows, side="right")
        # The running number of a triangle within its polygon.
        within = rows - (ends[polygon] - counts[polygon])
        firsts = starts[polygon][:, None]
        yield values[firsts + np.stack([0 * within, within + 1, within + 2], axis=1)]
