"""The motion from which a local method starts."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float

from cfr_jax.io import PointCloud

Start = Literal["identity", "centroid"]


def initial(source: PointCloud, target: PointCloud, start: Start) -> Float[np.ndarray, "4 4"]:
    """The identity, or the translation that moves the source's centroid onto the target's.

    Raises ValueError for an unknown `start`.
    """
    if start not in ("identity", "centroid"):
        raise ValueError(f"start is {start!r}, wanted 'identity' or 'centroid'")
    motion = np.eye(4)
    if start == "centroid":
        motion[:3, 3] = target.points.mean(axis=0) - source.points.mean(axis=0)
    return motion
