"""Where the network may start: motions of unit clouds."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Float

from cfr_jax.geometry import motions, units

_MEETING = 1.5  # radii between the centers; two unit balls touch at two
COUNT = 128  # no rotation is farther than 46 degrees from one of them, and most within 24


def everywhere() -> Float[np.ndarray, "s 4 4"]:
    """A cover of all rotations, centroid on centroid."""
    return motions.motion(motions.cover(COUNT))


def around() -> Float[np.ndarray, "s 4 4"]:
    """Starts around the one where the clouds lie, for a second look: that one, and turns about six
    axes by 40 and about the eight between them by 50 degrees."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    between = np.array(list(itertools.product((1, -1), repeat=3))) / np.sqrt(3)
    turns = np.concatenate([np.zeros((1, 3)), 40 * axes, 50 * between])
    return motions.motion(motions.from_rotvec(np.radians(turns)))


def as_they_lie(frames: units.Frames) -> Float[np.ndarray, "s 4 4"]:
    """The caller's clouds just as they come, as a start of unit clouds: scans of one scene often
    share a frame. None where the clouds then lie too far from each other to meet."""
    unit = frames.to_unit(np.eye(4))[None]
    return unit[np.linalg.norm(unit[:, :3, 3], axis=1) <= _MEETING]


def given(frames: units.Frames, starts: Float[np.ndarray, "s 4 4"]) -> Float[np.ndarray, "s 4 4"]:
    """Starts of the caller's clouds as those of unit clouds. Raises ValueError as `align` does."""
    unit_starts = frames.to_unit(starts)
    away = np.abs(unit_starts[:, :3, 3]).max(axis=1)
    if away.max() > units.FARTHEST:
        raise ValueError(
            f"initial: number {away.argmax()} leaves the source {away.max():.3g} radii away "
            f"from the target, wanted at most {units.FARTHEST:g}"
        )
    return unit_starts
