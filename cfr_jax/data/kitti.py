"""Pairs of LiDAR scans from the KITTI odometry benchmark (Geiger et al., 2012).

The folder has the layout of the benchmark's unpacked downloads:

    sequences/NN/velodyne/000000.bin ...  float32 x, y, z, reflectance; meters around the sensor
    sequences/NN/calib.txt                a line `Tr:` with the motion from LiDAR to camera
    poses/NN.txt                          one line per frame: the motion from its camera frame to
                                          that of the first frame

Pairs follow the published procedure. A pair is a frame and the first later frame more than 10 m
away. The recorded motion is refined by point-to-plane ICP, and only pairs that the refinement
confirms are kept.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int

from cfr_jax.data.pairs import Pair
from cfr_jax.data.perturbations import random_motion, resample
from cfr_jax.data.scans import estimate_normals, refine_point_to_plane, voxel_mean
from cfr_jax.geometry import motions
from cfr_jax.runtime.atomic import unfinished
from cfr_jax.runtime.messages import Refused, shown
from cfr_jax.runtime.progress import Progress
from cfr_jax.runtime.reading import text

VOXEL = 0.3  # m
NORMAL_RADIUS = 3.0  # m
ICP_THRESHOLD = 1.0  # m
MIN_FITNESS = 0.65
LAYOUT = (
    "The folder must hold sequences/NN/velodyne/*.bin, sequences/NN/calib.txt and poses/NN.txt. "
    "Download `velodyne laser data`, `calibration files` and `ground truth poses` of the odometry "
    "benchmark from https://www.cvlibs.net/datasets/kitti/eval_odometry.php."
)


@dataclass(frozen=True, eq=False)
class ScanPairs:
    """Pairs of frames of one sequence, with refined true motions.

    `frames[p]` is (source, target), where the source is the earlier frame. `transforms[p]` maps
    source onto target, each in its own LiDAR frame. `fitness[p]` is the share of source points that
    `transforms[p]` brings within 1 m of the target.
    """

    folder: Path
    sequence: str
    frames: Int[np.ndarray, "p 2"]
    transforms: Float[np.ndarray, "p 4 4"]
    fitness: Float[np.ndarray, " p"]

    def __len__(self) -> int:
        return len(self.frames)


def scan_pair(
    scans: ScanPairs, index: int, points: int = 4000, angle: float = 45.0, translation: float = 15.0
) -> Pair:
    """Pair `index`, with a random motion applied to its source.

    Both clouds are thinned to voxels of 0.3 m and then to `points` points; a cloud with fewer
    points repeats some. The same index always gives the same pair, as in `fixed_pair`.
    """
    if not 0 <= index < len(scans):
        raise ValueError(f"index: got {index}, wanted 0 to {len(scans) - 1}")
    rng = np.random.RandomState(index)
    motion = random_motion(angle, translation, rng).astype(np.float64)
    clouds = []
    for frame in scans.frames[index]:
        thinned = read_frame(scans.folder, scans.sequence, int(frame))
        normals = estimate_normals(thinned, NORMAL_RADIUS)
        chosen = resample(len(thinned), points, rng)
        clouds.append((thinned[chosen], normals[chosen]))
    (source, source_normals), (target, target_normals) = clouds
    source_frame, target_frame = scans.frames[index]
    return Pair(
        name=f"{scans.sequence}/{source_frame:06d}-{target_frame:06d}",
        source=motions.apply(motion, source).astype(np.float32),
        target=target,
        source_normals=motions.rotate(motion, source_normals).astype(np.float32),
        target_normals=target_normals,
        transform=scans.transforms[index] @ np.linalg.inv(motion),
        overlap=float(scans.fitness[index]),
    )


def read_pairs(
    folder: str | Path,
    sequence: str,
    cache: str | Path | None = None,
    distance: float = 10.0,
    stride: int | None = None,
) -> ScanPairs:
    """The pairs of a sequence.

    `cache` is an .npz file that keeps the refined motions, because refining takes a second per pair
    of full scans. It is used if it was written for the same sequence, poses and settings, and
    written otherwise. For `distance` and `stride` see `select_frames`. Raises ValueError if the
    sequence is missing or malformed.
    """
    folder = Path(folder)
    poses = read_poses(folder, sequence)
    frames = select_frames(poses, distance, stride)
    settings = json.dumps([sequence, VOXEL, NORMAL_RADIUS, ICP_THRESHOLD, frames.tolist()])
    made_for = hashlib.sha256(settings.encode() + poses.tobytes()).hexdigest()
    kept = _load(Path(cache), made_for) if cache is not None else None
    if kept is None:
        kept = _refine(folder, sequence, poses, frames)
        if cache is not None:
            _save(Path(cache), made_for, *kept)
    transforms, fitness = kept
    good = fitness > MIN_FITNESS
    return ScanPairs(folder, sequence, frames[good], transforms[good], fitness[good])


def select_frames(
    poses: Float[np.ndarray, "f 4 4"], distance: float = 10.0, stride: int | None = None
) -> Int[np.ndarray, "p 2"]:
    """Pairs of a frame and the first later frame more than `distance` meters away.

    As published, the next pair starts with the frame after the end of the last pair. With a
    `stride`, it starts that many frames after the start of the last pair, which gives more pairs
    that share frames.
    """
    if stride is not None and stride < 1:
        raise ValueError(f"stride: got {stride}, wanted None or at least 1 frame")
    places = poses[:, :3, 3]
    pairs, start = [], 0
    while start < len(places):
        far = np.flatnonzero(np.linalg.norm(places[start:] - places[start], axis=1) > distance)
        if not len(far):
            break
        pairs.append((start, start + far[0]))
        start = start + (stride or far[0] + 1)
    return np.array(pairs, np.int64).reshape(-1, 2)


def read_poses(folder: str | Path, sequence: str) -> Float[np.ndarray, "f 4 4"]:
    """For each frame, the motion from its LiDAR frame to that of the first frame."""
    folder = Path(folder)
    rows = _numbers(folder / "poses" / f"{sequence}.txt", "12 numbers per line", str.split)
    calibration = _numbers(
        folder / "sequences" / sequence / "calib.txt",
        "a line `Tr:` with 12 numbers",
        lambda line: line.split()[1:] if line.startswith("Tr:") else [],
    )
    to_camera = _motions(calibration)[0]
    return np.linalg.inv(to_camera) @ _motions(rows) @ to_camera


def read_frame(
    folder: str | Path, sequence: str, frame: int, voxel: float = VOXEL
) -> Float32[np.ndarray, "n 3"]:
    """The points of one scan in meters, one per voxel; with a voxel size of 0, all points."""
    path = Path(folder) / "sequences" / sequence / "velodyne" / f"{frame:06d}.bin"
    if not path.is_file():
        raise ValueError(f"no scan at {path}. {LAYOUT}")
    values = np.fromfile(path, np.float32)
    if not len(values) or len(values) % 4 or not np.isfinite(values).all():
        raise ValueError(f"{path} is not a scan: wanted finite float32 x, y, z, reflectance")
    points = values.reshape(-1, 4)[:, :3]
    return voxel_mean(points, voxel) if voxel else points


def _refine(
    folder: Path, sequence: str, poses: np.ndarray, frames: np.ndarray
) -> tuple[Float[np.ndarray, "p 4 4"], Float[np.ndarray, " p"]]:
    transforms, fitness = np.empty((len(frames), 4, 4)), np.empty(len(frames))
    for row, (source, target) in enumerate(Progress(frames, f"KITTI {sequence}")):
        cloud = read_frame(folder, sequence, int(target))
        transforms[row], fitness[row] = refine_point_to_plane(
            read_frame(folder, sequence, int(source)),
            cloud,
            estimate_normals(cloud, NORMAL_RADIUS),
            np.linalg.inv(poses[target]) @ poses[source],
            ICP_THRESHOLD,
        )
    return transforms, fitness


def _numbers(
    path: Path, wanted: str, parts: Callable[[str], list[str]]
) -> Float[np.ndarray, "n 12"]:
    if not path.is_file():
        raise ValueError(f"no {path}. {LAYOUT}")
    try:
        rows = [parts(line) for line in text(path).splitlines()]
        values = np.array([[float(x) for x in row] for row in rows if row])
    except ValueError as error:
        raise Refused(f"{shown(path)}: {error}; wanted {wanted}") from error
    if values.ndim != 2 or values.shape[1] != 12 or not np.isfinite(values).all():
        raise ValueError(f"{path} is malformed; wanted {wanted}")
    return values


def _motions(rows: Float[np.ndarray, "n 12"]) -> Float[np.ndarray, "n 4 4"]:
    motions = np.tile(np.eye(4), (len(rows), 1, 1))
    motions[:, :3] = rows.reshape(-1, 3, 4)
    return motions


def _load(path: Path, made_for: str) -> tuple[np.ndarray, np.ndarray] | None:
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as held:
            same = str(held["made_for"]) == made_for
            return (held["transforms"], held["fitness"]) if same else None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"cache {path} cannot be read ({error}); remove it") from error


def _save(path: Path, made_for: str, transforms: np.ndarray, fitness: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with unfinished(path) as beside, open(beside, "wb") as file:
        np.savez(file, made_for=made_for, transforms=transforms, fitness=fitness)
