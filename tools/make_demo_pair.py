"""Makes the pair of scans that ships with the package: two views of a forklift.

    python tools/make_demo_pair.py PACKAGE_OR_LIBRARY [--out cfr_jax/cli/demo_pair]

The argument is `sweethome3d-furniture_1.8-1_all.deb` (`apt-get download sweethome3d-furniture`), or
the file `BlendSwap-CC-0.sh3f` in it. The object's category, vehicles, is not used for training.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from cfr_jax.data.making.furniture import FurnitureLibrary
from cfr_jax.data.making.packages import extract
from cfr_jax.geometry import motions
from cfr_jax.io.mesh import Mesh

PIECE = "Blend Swap CC-0#forkLift"
LIBRARY = "usr/share/sweethome3d/furniture/BlendSwap-CC-0.sh3f"
POINTS = 6000  # per view
DENSE = 400_000  # points on the whole surface, some of which the camera sees
NOISE = 0.01  # meters, standard deviation; typical of a time-of-flight camera at this distance
DISTANCE = 6.0  # meters from the sensor to the object's center
CELL = 0.004  # width of a pixel of the depth image divided by its depth
SEED = 7

# The poses of the object in front of the two sensors: angles about x, y, z in degrees
# (R = Rx Ry Rz), and the offset from the line of sight in meters.
SOURCE_VIEW = ((24.0, 36.0, 7.0), (0.25, -0.10, 0.15))
TARGET_VIEW = ((14.0, -6.0, 0.0), (-0.20, 0.05, 0.0))

LICENSE = """\
# The demo pair

`source.ply` and `target.ply` are two simulated scans of "{name}" by {creator}, a model that its
author released under CC0 1.0 (public domain dedication,
https://creativecommons.org/publicdomain/zero/1.0/) as Blend #90949, "Basic Low Poly Fork-Lift",
on blendswap.com. It was taken from Debian's package `sweethome3d-furniture` 1.8-1,
`{source}`. The scans are released under CC0 1.0 as well.

Made by `tools/make_demo_pair.py`: {how}
"""
HOW = (
    f"points drawn by area on the mesh at its true size (meters), those seen by a virtual depth "
    f"camera kept (depth image, hidden points removed), {POINTS} of them with {NOISE * 100:g} cm "
    "of Gaussian noise per coordinate, each view in the frame of its own sensor (y up, the object "
    f"some {DISTANCE:g} m ahead along -z); the two views share no point."
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("package", type=Path, help="sweethome3d-furniture_*.deb or the .sh3f file")
    parser.add_argument("--out", type=Path, default=Path("cfr_jax/cli/demo_pair"))
    args = parser.parse_args()

    mesh, name, creator = fork_lift(args.package)
    rng = np.random.default_rng(SEED)
    source_pose, target_pose = sensor_pose(*SOURCE_VIEW), sensor_pose(*TARGET_VIEW)
    args.out.mkdir(parents=True, exist_ok=True)
    for role, pose in (("source", source_pose), ("target", target_pose)):
        write_ply(args.out / f"{role}.ply", scan(mesh, pose, rng))
    source = f"{LIBRARY}: {PIECE}"
    truth = {
        "transform": (target_pose @ np.linalg.inv(source_pose)).tolist(),
        "object": name,
        "source": source,
        "licence": "CC0-1.0",
        "how": HOW,
    }
    (args.out / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")
    license_text = LICENSE.format(name=name, creator=creator, source=source, how=HOW)
    (args.out / "LICENSE.md").write_text(license_text)


def fork_lift(package: Path) -> tuple[Mesh, str, str]:
    """The mesh in meters, the object's name, and its author's name."""
    with tempfile.TemporaryDirectory() as folder:
        if package.suffix == ".deb":
            (package,) = extract(package, lambda name: name == LIBRARY, Path(folder))
        with FurnitureLibrary(package) as library:
            piece = next(piece for piece in library.pieces if piece.identifier == PIECE)
            return piece.scaled(library.mesh(piece)), piece.name, piece.creator


def sensor_pose(
    angles: tuple[float, float, float], offset: tuple[float, float, float]
) -> Float[np.ndarray, "4 4"]:
    """The motion from the object's frame to the sensor's, which looks along -z with y up."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(np.radians(angles)), np.sin(np.radians(angles))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3] = about_x @ about_y @ about_z
    pose[:3, 3] = np.add(offset, (0.0, 0.0, -DISTANCE))
    return pose


def scan(
    mesh: Mesh, pose: Float[np.ndarray, "4 4"], rng: np.random.Generator
) -> Float[np.ndarray, "n 3"]:
    surface = motions.apply(pose, mesh.points(DENSE, int(rng.integers(1 << 31))).points)
    seen = np.flatnonzero(visible(surface))
    chosen = surface[rng.choice(seen, POINTS, replace=False)]
    return chosen + rng.normal(0.0, NOISE, chosen.shape)


def visible(points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Which points a depth camera sees: those about as near as the nearest in their pixel."""
    depth = -points[:, 2]
    column, row = np.floor(points[:, :2] / depth[:, None] / CELL).astype(int).T
    pixel = (row - row.min()) * (np.ptp(column) + 1) + column - column.min()
    nearest = np.full(pixel.max() + 1, np.inf)
    np.minimum.at(nearest, pixel, depth)
    # On a slanted face, one pixel covers a range of depths.
    return depth < nearest[pixel] + 2.5 * CELL * DISTANCE


def write_ply(path: Path, points: Float[np.ndarray, "n 3"]) -> None:
    properties = "\n".join(f"property float {axis}" for axis in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}\n"
    path.write_bytes(header.encode() + b"end_header\n" + points.astype("<f4").tobytes())


if __name__ == "__main__":
    main()
