"""Error measures of predicted against true transforms, in float64 numpy and scipy.

Transforms are stacks (b, 4, 4), each mapping its source onto its reference. Angles are degrees,
lengths are the unit of the clouds.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from .pieces import move

Array = np.ndarray


def err_r(predicted: Float[Array, "b 4 4"], truth: Float[Array, "b 4 4"]) -> Float[Array, " b"]:
    """Angle of the rotation left between prediction and truth."""
    residual = np.swapaxes(truth[:, :3, :3], 1, 2) @ predicted[:, :3, :3]
    cosine = (np.trace(residual, axis1=1, axis2=2) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def err_t(predicted: Float[Array, "b 4 4"], truth: Float[Array, "b 4 4"]) -> Float[Array, " b"]:
    """Length of the translation of inverse(truth) composed after the prediction."""
    return np.linalg.norm((np.linalg.inv(truth) @ predicted)[:, :3, 3], axis=1)


def euler_difference(
    predicted: Float[Array, "b 4 4"], truth: Float[Array, "b 4 4"]
) -> Float[Array, "b 3"]:
    """Difference of the 'xyz' Euler angles (about the fixed axes), axis by axis.

    Not wrapped: 179 against -179 counts as 358, since the published definition says "difference"
    and no more. The protocols' angles stay within 45 and never come near.
    """
    angles = [
        Rotation.from_matrix(stack[:, :3, :3]).as_euler("xyz", degrees=True)
        for stack in (predicted, truth)
    ]
    return angles[0] - angles[1]


def axis_errors(predicted: Float[Array, "b 4 4"], truth: Float[Array, "b 4 4"]) -> dict[str, float]:
    """`r_mae`, `r_rmse`, `t_mae`, `t_rmse`: over all pairs and the three axes together."""
    rotation = euler_difference(predicted, truth)
    translation = predicted[:, :3, 3] - truth[:, :3, 3]
    return {
        "r_mae": float(np.abs(rotation).mean()),
        "r_rmse": float(np.sqrt((rotation**2).mean())),
        "t_mae": float(np.abs(translation).mean()),
        "t_rmse": float(np.sqrt((translation**2).mean())),
    }


def chamfer(
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    clean: Float[Array, "p 3"],
    predicted: Float[Array, "4 4"],
    truth: Float[Array, "4 4"],
) -> float:
    """Modified Chamfer distance of one pair: mean squared distances, so in squared units.

    `source` and `reference` are the clouds as registered (cropped, noisy), each in its own frame;
    `clean` is the whole shape without noise in the frame of the reference. The moved source is
    held against it, and the reference against it as moved by predicted @ inverse(truth): the
    frame of the reference back to that of the source, and forward as predicted.
    """
    carried = move(predicted @ np.linalg.inv(truth), clean)
    forward = cdist(move(predicted, source), clean, "sqeuclidean").min(axis=1).mean()
    backward = cdist(reference, carried, "sqeuclidean").min(axis=1).mean()
    return float(forward + backward)
