"""Files and answers for the tests of the command line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from cfr_jax import io
from cfr_jax.alignment.answers import Alignment

INLIER_DISTANCE = 0.05


def motion(degrees: float = 20.0, translation=(0.3, -0.1, 0.2)) -> np.ndarray:
    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_rotvec(
        np.deg2rad(degrees) * np.array([0.6, 0.0, 0.8])
    ).as_matrix()
    transform[:3, 3] = translation
    return transform


# Corner and two sides of each plate of a chair that has lost a leg: only one motion lays it on
# itself.
PLATES = np.array(
    [
        [[0.0, 0.0, 0.5], [0.6, 0.0, 0.0], [0.0, 0.5, 0.0]],  # seat
        [[0.0, 0.0, 0.5], [0.0, 0.5, 0.0], [-0.1, 0.0, 0.6]],  # back
        [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, 0.5]],  # legs
        [[0.0, 0.5, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, 0.5]],
        [[0.6, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.5]],
    ]
)


def points(count: int, seed: int) -> np.ndarray:
    """A sampling of the chair by area."""
    rng = np.random.default_rng(seed)
    areas = np.linalg.norm(np.cross(PLATES[:, 1], PLATES[:, 2]), axis=1)
    corner, first, second = PLATES[rng.choice(len(PLATES), count, p=areas / areas.sum())].swapaxes(
        0, 1
    )
    along, across = rng.uniform(size=(2, count, 1))
    return corner + along * first + across * second


def write_pair(folder: Path, count: int = 700) -> tuple[str, str]:
    """Two samplings of one surface, the second moved by `motion()`; their paths."""
    target = points(count + 20, 1) @ motion()[:3, :3].T + motion()[:3, 3]
    io.write(folder / "source.ply", io.PointCloud(points(count, 0)))
    io.write(folder / "target.xyz", io.PointCloud(target))
    return str(folder / "source.ply"), str(folder / "target.xyz")


def alignment(source: io.PointCloud, target: io.PointCloud, **changes) -> Alignment:
    """What `align` might answer: `motion()` in two iterations and a refinement."""
    used = np.arange(0, len(source), 2)
    fields = {
        "transform": motion(),
        "transforms": np.stack([motion(10.0), motion(19.0)]),
        "refined": True,
        "confidence": 0.875,
        "clues": {"fitness": 0.75},
        "fitness": 0.75,
        "inlier_rmse": 0.0125,
        "inlier_distance": INLIER_DISTANCE,
        "determined": True,
        "warnings": (),
        "weights": np.linspace(0.0, 1.0, len(used)),
        "source_rows": used,
        "target_rows": np.arange(len(target)),
        "neighbors": 64,
        "seconds": {"compile": 2.0, "run": 0.25, "total": 2.5},
    }
    return Alignment(**(fields | changes))
