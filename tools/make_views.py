"""Writes folders of depth views of open CAD shapes, each with the true poses, for `cfr merge`.

    python -m tools.make_views --library furniture.deb --corpus val.h5 --out views [--shapes 40]

The library is `sweethome3d-furniture_1.8-1_all.deb` (`apt-get download sweethome3d-furniture`); of
the shapes in the corpus, the first that come from it are taken. Each becomes a folder: the views
of depth cameras all around it, each turned by up to 45 degrees about every axis, and `poses.json`
with the motions that bring them back. Views have names without order.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
from jaxtyping import Float

from cfr_jax import io
from cfr_jax.data.making.furniture import FurnitureLibrary
from cfr_jax.data.making.packages import extract
from cfr_jax.geometry import motions
from cfr_jax.io.mesh import Mesh
from tools.make_demo_pair import visible

SOURCE = "sweethome3d:"
DENSE = 200_000  # points on the whole surface, some of which a camera sees
AWAY = 6.0  # radii from the camera to the center: `visible` is made for this distance
HEIGHTS = (10.0, 35.0)  # degrees of the cameras above the horizon
TURN = 45.0  # degrees about each axis
SHIFT = 0.5  # radii


def main() -> None:
    """Writes the folders."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--library", type=Path, required=True)
    parser.add_argument("--corpus", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--shapes", type=int, default=40)
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--points", type=int, default=3000)
    parser.add_argument("--noise", type=float, default=0.005, help="radii, standard deviation")
    args = parser.parse_args()
    with h5py.File(args.corpus) as corpus:
        names = [str(name) for name in corpus["names"].asstr()[:]]
    names = [name for name in names if name.startswith(SOURCE)][: args.shapes]
    for name, mesh in meshes(args.library, names):
        folder = args.out / re.sub(r"\W+", "_", name.removeprefix(SOURCE))
        folder.mkdir(parents=True, exist_ok=True)
        rng = np.random.default_rng(hash_of(name))
        surface = unit(mesh.points(DENSE, int(rng.integers(1 << 31))).points)
        poses = {}
        for label in rng.permutation(args.views):
            azimuth = 360.0 * len(poses) / args.views
            seen = view(surface, azimuth, rng, args.points, args.noise)
            pose = motions.motion(
                turned(rng.uniform(-TURN, TURN, 3)),
                rng.uniform(-SHIFT, SHIFT, 3),
            )
            file = f"view_{label:02d}.ply"
            io.write(folder / file, io.PointCloud(motions.apply(motions.inverse(pose), seen)))
            poses[file] = pose.tolist()
        (folder / "poses.json").write_text(json.dumps({"poses": poses}, indent=1) + "\n")
        print(folder)


def meshes(deb: Path, names: list[str]) -> Iterator[tuple[str, Mesh]]:
    """The meshes of these names, each as it is in its library."""
    with tempfile.TemporaryDirectory() as work:
        for path in extract(deb, lambda name: name.endswith(".sh3f"), Path(work), quiet=True):
            with FurnitureLibrary(path) as library:
                for piece in library.pieces:
                    name = f"{SOURCE}{path.stem}/{piece.identifier}"
                    if name in names:
                        yield name, library.mesh(piece)


def unit(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Centered, with a radius of one."""
    points = points - points.mean(axis=0)
    return points / np.linalg.norm(points, axis=1).max()


def view(
    surface: Float[np.ndarray, "n 3"],
    azimuth: float,
    rng: np.random.Generator,
    points: int,
    noise: float,
) -> Float[np.ndarray, "m 3"]:
    """What a camera sees from there, with noise, in the object's frame."""
    camera = turned((rng.uniform(*HEIGHTS), 0, 0)) @ turned((0, azimuth, 0))
    ahead = surface @ camera.T - (0, 0, AWAY)
    seen = np.flatnonzero(visible(ahead))
    chosen = surface[rng.choice(seen, min(points, len(seen)), replace=False)]
    return chosen + rng.normal(0.0, noise, chosen.shape)


def turned(angles: tuple[float, float, float] | Float[np.ndarray, " 3"]) -> np.ndarray:
    """Rx Ry Rz of angles in degrees."""
    about_x, about_y, about_z = motions.from_rotvec(np.diag(np.radians(angles)))
    return about_x @ about_y @ about_z


def hash_of(name: str) -> int:
    """A seed that a name always has."""
    return int.from_bytes(name.encode()[-7:], "little")


if __name__ == "__main__":
    main()
