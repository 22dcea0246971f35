"""An even cover of the rotations of 3D space, the same every time."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def cover(count: int) -> Float[np.ndarray, "count 3 3"]:
    """`count` rotations spread evenly over SO(3); the first ones are no cover of their own.

    Super-Fibonacci spirals (Alexa, CVPR 2022): quaternion i winds about two circles at angles that
    advance by 1 / sqrt(2) and by 1 / psi of a turn, psi^4 = psi + 4, while its weight goes evenly
    from one circle to the other. The farthest that any rotation is from the nearest of them is
    61 degrees for 64, 46 for 128, 37 for 256 (`tests/test_rotations.py` measures it). Raises
    ValueError for a count below 1.
    """
    # imported here: half a second that only a search of all rotations has to wait for
    from scipy.optimize import brentq
    from scipy.spatial.transform import Rotation

    if count < 1:
        raise ValueError(f"count: got {count} rotations, wanted at least 1")
    psi = brentq(lambda x: x**4 - x - 4, 1, 2)
    place = np.arange(count) + 0.5
    share = place / count
    first, second = 2 * np.pi * place / np.sqrt(2), 2 * np.pi * place / psi
    inner, outer = np.sqrt(share), np.sqrt(1 - share)
    quaternions = np.stack(
        [
            inner * np.sin(first),
            inner * np.cos(first),
            outer * np.sin(second),
            outer * np.cos(second),
        ],
        axis=1,
    )
    return Rotation.from_quat(quaternions).as_matrix()
