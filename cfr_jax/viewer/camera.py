"""The camera: one view of a scene, shared by the page and the picture."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from cfr_jax.viewer.scene import Scene

# Share of points that must be inside the frame. With every stray point of a scan in the frame, the
# rest would be a dot.
INSIDE = 0.99
MARGIN = 1.04

# Looking straight along the direction of least spread flattens the shape. Looking a little from
# above and from the side gives depth.
PITCH = np.deg2rad(24.0)
YAW = np.deg2rad(-28.0)


@dataclass(frozen=True)
class Camera:
    """A camera without a lens.

    The rows of `rotation` (3, 3) are the directions right, up and toward the viewer, in the
    target's frame. `center` (3,) is the middle of the target and the final source, in the caller's
    units. It is the same at all stations, so that the target never moves. `radii` (S,) says for
    each station how far the target and the moved source extend from `center`.
    """

    rotation: Float64[np.ndarray, "3 3"]
    center: Float64[np.ndarray, " 3"]
    radii: Float64[np.ndarray, " s"]


def best_view(scene: Scene) -> Camera:
    """Camera that looks along the direction of least spread of the aligned clouds, tilted a
    little."""
    together = np.concatenate([scene.target, scene.moved(-1)])
    low, high = np.quantile(together, [1 - INSIDE, INSIDE], axis=0)
    center = (low + high) / 2
    reaches = [_reach(scene.moved(k), center) for k in range(len(scene.transforms))]
    radii = np.maximum(reaches, _reach(scene.target, center))
    # A single point, or points that all coincide, still need a frame of some size.
    radii = np.maximum(radii, max(1e-9, 1e-9 * np.abs(center).max())) * MARGIN
    rotation = _turn_x(PITCH) @ _turn_y(YAW) @ _principal_axes(together)
    return Camera(rotation=rotation, center=center, radii=radii)


def _reach(points: Float64[np.ndarray, "n 3"], center: Float64[np.ndarray, " 3"]) -> float:
    return float(np.quantile(np.linalg.norm(points - center, axis=1), INSIDE))


def _principal_axes(points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "3 3"]:
    """The widest, middle and narrowest direction as rows; a right-handed frame.

    The signs of eigenvectors are arbitrary. The directions up and toward the viewer get signs that
    make their largest component positive, which keeps z-up and y-up shapes upright.
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
