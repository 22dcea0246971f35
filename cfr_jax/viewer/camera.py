"""Where to look from: one view of a scene, shared by the page and the picture."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from cfr_jax.viewer.scene import Scene

# Scans carry stray points; a frame that must hold every last one of them shows the rest as a dot.
INSIDE = 0.99
MARGIN = 1.04

# Straight along the least spread flattens the shape; a little from above and aside gives depth.
PITCH = np.deg2rad(24.0)
YAW = np.deg2rad(-28.0)


@dataclass(frozen=True)
class Camera:
    """A camera without a lens.

    `rotation` (3, 3) has as rows the directions right, up and toward the viewer, in the target's
    frame. `center` (3,) is the middle of target and final source, in the caller's units; it stays
    the same at all stations so that the target never moves. `radii` (S,) is, for each station, how
    far around `center` target and moved source reach.
    """

    rotation: Float64[np.ndarray, "3 3"]
    center: Float64[np.ndarray, " 3"]
    radii: Float64[np.ndarray, " s"]


def best_view(scene: Scene) -> Camera:
    """Camera along the direction of least spread of the aligned clouds, tilted a little."""
    together = np.concatenate([scene.target, scene.moved(-1)])
    low, high = np.quantile(together, [1 - INSIDE, INSIDE], axis=0)
    center = (low + high) / 2
    reaches = [_reach(scene.moved(k), center) for k in range(len(scene.transforms))]
    radii = np.maximum(reaches, _reach(scene.target, center))
    # A single point, or all points in one place, still needs a frame of some size.
    radii = np.maximum(radii, max(1e-9, 1e-9 * np.abs(center).max())) * MARGIN
    rotation = _turn_x(PITCH) @ _turn_y(YAW) @ _principal_axes(together)
    return Camera(rotation=rotation, center=center, radii=radii)


def _reach(points: Float64[np.ndarray, "n 3"], center: Float64[np.ndarray, " 3"]) -> float:
    return float(np.quantile(np.linalg.norm(points - center, axis=1), INSIDE))


def _principal_axes(points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "3 3"]:
    """Rows: widest, middle and narrowest direction; a right-handed frame.

    Eigenvectors come with arbitrary signs: up and toward the viewer are turned so that their
    largest component is positive, which keeps z-up and y-up shapes the right way up.
    """
    _, axes = np.linalg.eigh(np.cov(points.T, ddof=0))  # ascending, in columns
    toward, up = (axis * np.sign(axis[np.abs(axis).argmax()]) for axis in axes.T[:2])
    return np.stack([np.cross(up, toward), up, toward])


def _turn_x(angle: float) -> Float64[np.ndarray, "3 3"]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _turn_y(angle: float) -> Float64[np.ndarray, "3 3"]:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
