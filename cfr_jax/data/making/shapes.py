"""Turns a mesh into a shape: cleaned, checked, sampled by area, and scaled to the unit sphere.

All random numbers are seeded by the shape's name, so a shape does not depend on the order or the
number of the others.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64
from scipy.spatial import cKDTree

from cfr_jax.io.cloud import as_float64
from cfr_jax.io.mesh import Mesh, areas_and_normals, sample_triangles

FLATTEST = 0.05  # minimum ratio of the smallest extent to the largest
DENSEST = 0.2  # minimum median distance to the mean, for a shape with largest norm 1
GRID = 1e-3  # vertices of exact duplicates agree on this grid, for a shape with largest norm 1


class Unfit(ValueError):
    """The mesh is not fit for a corpus. The message says why; equal reasons have equal messages."""


@dataclass(frozen=True, eq=False)
class Shape:
    """Points in the unit sphere about their mean, with unit normals of the faces they lie on."""

    points: Float32[np.ndarray, "p 3"]
    normals: Float32[np.ndarray, "p 3"]
    spacing: float  # mean distance to the nearest point of a second sample of the same mesh
    fingerprint: str  # equal for meshes whose vertices are equal up to position and scale


def make_shape(mesh: Mesh, name: str, points: int = 2048, least_faces: int = 20) -> Shape:
    """Samples a mesh. Raises `Unfit` if it is not fit for a corpus.

    A mesh is fit if it has at least `least_faces` faces with an area, if its smallest extent is at
    least 5 % of its largest, both along the file's axes and along the principal axes, and if the
    median distance of its points to their mean is at least a fifth of the largest.
    """
    corners = clean_triangles(mesh)
    if len(corners) < least_faces:
        raise Unfit(f"fewer than {least_faces} faces with an area")
    vertices = corners.reshape(-1, 3)
    if _flatness(vertices) < FLATTEST:
        raise Unfit("flat")
    sampled, normals = sample_triangles(corners, points, name_generator(name, "sample"))
    # Principal axes of the surface, not of the vertices, which are dense where there is detail.
    axes = np.linalg.eigh(np.cov(sampled.T))[1]
    if _flatness(vertices @ axes) < FLATTEST:
        raise Unfit("flat")
    center = sampled.mean(axis=0)
    radius = np.linalg.norm(sampled - center, axis=1).max()
    unit = (sampled - center) / radius
    if np.median(np.linalg.norm(unit, axis=1)) < DENSEST:
        raise Unfit("concentrated about one place")
    again, _ = sample_triangles(corners, points, name_generator(name, "second sample"))
    spacing = mean_nearest(unit, (again - again.mean(axis=0)) / radius)
    return Shape(
        unit.astype(np.float32), normals.astype(np.float32), spacing, _fingerprint(vertices)
    )


def name_generator(name: str, purpose: str) -> np.random.Generator:
    """A generator for one shape and one purpose, the same on every machine."""
    digest = hashlib.sha256(f"{purpose}\n{name}".encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:16], "little"))


def name_share(name: str, purpose: str) -> float:
    """A number in [0, 1) that depends on the name and is uniform over names."""
    digest = hashlib.sha256(f"{purpose}\n{name}".encode()).digest()
    return int.from_bytes(digest[:8], "big") / 2**64


def clean_triangles(mesh: Mesh) -> Float64[np.ndarray, "t 3 3"]:
    """Corners of the triangles that are finite and have an area. Raises `Unfit` if there are none
    or if the mesh is broken."""
    vertices = as_float64(mesh.vertices).reshape(-1, 3)
    triangles = mesh.triangles
    if len(triangles) and not 0 <= triangles.min() <= triangles.max() < len(vertices):
        raise Unfit("a face names a vertex that is not there")
    corners = vertices[triangles]
    corners = corners[np.isfinite(corners).all(axis=(1, 2))]
    if len(corners) == 0:
        raise Unfit("no faces")
    extent = np.ptp(corners.reshape(-1, 3), axis=0).max()
    if not 0 < extent < 1e12:
        raise Unfit("no extent, or none that is a number")
    fit: Bool[np.ndarray, " t"] = areas_and_normals(corners / extent)[0] > 1e-14
    if not fit.any():
        raise Unfit("no faces")
    return corners[fit]


def _flatness(points: Float64[np.ndarray, "n 3"]) -> float:
    extents = np.ptp(points, axis=0)
    return float(extents.min() / extents.max())


def mean_nearest(points: Float[np.ndarray, "n 3"], others: Float[np.ndarray, "m 3"]) -> float:
    """Mean distance to the nearest point of the other cloud, averaged over both directions."""
    forth = cKDTree(others).query(points)[0].mean()
    return float(forth + cKDTree(points).query(others)[0].mean()) / 2


def _fingerprint(vertices: Float64[np.ndarray, "v 3"]) -> str:
    unique = np.unique(vertices, axis=0)
    centered = unique - unique.mean(axis=0)
    scaled = centered / np.linalg.norm(centered, axis=1).max()
    # Adding zero turns -0. into 0., because the two have different bytes.
    rounded = np.unique(np.round(scaled / GRID) + 0.0, axis=0)
    return hashlib.sha256(rounded.tobytes()).hexdigest()
