"""How far poses are from the truth, whatever frame they are in."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cfr_jax.evaluation.multiway.ways import Placed
from cfr_jax.geometry import motions


class PoseErrors(NamedTuple):
    """Of each placed scan, after the best common motion onto the truth."""

    degrees: Float[np.ndarray, " p"]
    lengths: Float[np.ndarray, " p"]
    """Of the scan's centroid."""


def pose_errors(
    poses: Float[np.ndarray, "p 4 4"],
    truth: Float[np.ndarray, "p 4 4"],
    centers: Float[np.ndarray, "p 3"],
) -> PoseErrors:
    """Errors after the motion that brings the poses onto the truth: the mean turn in the chordal
    sense, then the mean shift of the scans' `centers` (each in its scan's frame)."""
    turn = motions.nearest_rotation(np.einsum("pij,pkj->ik", truth[:, :3, :3], poses[:, :3, :3]))
    found, wanted = (
        np.einsum("pij,pj->pi", each[:, :3, :3], centers) + each[:, :3, 3]
        for each in (poses, truth)
    )
    shift = np.mean(wanted - found @ turn.T, axis=0)
    laid = motions.motion(turn, shift) @ poses
    lengths = np.linalg.norm(found @ turn.T + shift - wanted, axis=1)
    return PoseErrors(motions.angle_between(laid, truth), lengths)


def wrong_edges(
    found: Placed,
    truth: Float[np.ndarray, "n 4 4"],
    centers: Float[np.ndarray, "n 3"],
    limits: tuple[float, float],
) -> int:
    """How many edges are off by more than degrees or a length, at the source's center."""
    count = 0
    for source, target, transform in found.edges:
        wanted = motions.inverse(truth[target]) @ truth[source]
        center = centers[source]
        away = motions.apply(transform, center) - motions.apply(wanted, center)
        turned = float(motions.angle_between(transform, wanted))
        count += turned > limits[0] or float(np.linalg.norm(away)) > limits[1]
    return count
