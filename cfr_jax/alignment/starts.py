"""Starts for the network, as motions of unit clouds."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Float

from cfr_jax.geometry import motions, units

_MEETING = 1.5  # radii between the centers; two unit balls touch at two
COUNT = 128  # every rotation is within 46 degrees of one of them, and most are within 24


def everywhere() -> Float[np.ndarray, "s 4 4"]:
    """Rotations that cover all of SO(3), with centroid on centroid."""
    return motions.motion(motions.cover(COUNT))


def around() -> Float[np.ndarray, "s 4 4"]:
    """Starts for a second look: the position in which the clouds lie, and turns from it by 40
    degrees about six axes and by 50 degrees about the eight axes between them."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    between = np.array(list(itertools.product((1, -1), repeat=3))) / np.sqrt(3)
    turns = np.concatenate([np.zeros((1, 3)), 40 * axes, 50 * between])
    return motions.motion(motions.from_rotvec(np.radians(turns)))


def as_they_lie(frames: units.Frames) -> Float[np.ndarray, "s 4 4"]:
    """The start that leaves the caller's clouds where they are, as one motion of unit clouds. Scans
    of one scene often share a frame. Empty if the clouds are then too far apart to meet."""
    unit = frames.to_unit(np.eye(4))[None]
    return unit[np.linalg.norm(unit[:, :3, 3], axis=1) <= _MEETING]


def given(frames: units.Frames, starts: Float[np.ndarray, "s 4 4"]) -> Float[np.ndarray, "s 4 4"]:
    """Converts starts of the caller's clouds to motions of unit clouds. Raises ValueError if one of
    them leaves the clouds too far apart."""
    unit_starts = frames.to_unit(starts)
    away = np.abs(unit_starts[:, :3, 3]).max(axis=1)
    if away.max() > units.FARTHEST:
        raise ValueError(
            f"initial: number {away.argmax()} leaves the source {away.max():.3g} radii away "
            f"from the target, wanted at most {units.FARTHEST:g}"
        )
    return unit_starts
