"""Makes the views that `cfr demo --merge` merges: depth cameras all around a forklift.

    python -m tools.make_demo_views PACKAGE_OR_LIBRARY [--out cfr_jax/cli/demo_views]

The argument is that of `make_demo_pair`, and so is the object.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from cfr_jax.geometry import motions
from tools.make_demo_pair import LIBRARY, LICENSE, PIECE, SEED, fork_lift, write_ply
from tools.make_views import DENSE, turned, unit, view

VIEWS, POINTS, NOISE = 8, 1500, 0.004
TURN, SHIFT = 30.0, 0.5  # degrees about each axis, and radii
HOW = (
    f"points drawn by area on the mesh, scaled to a radius of one; those seen by each of {VIEWS} "
    f"virtual depth cameras around it kept, {POINTS} of them with noise, each view turned by up to "
    f"{TURN:g} degrees about every axis; `poses.json` holds the motions that bring them back."
)


def main() -> None:
    """Writes the views, their poses, and the license."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("package", type=Path, help="sweethome3d-furniture_*.deb or the .sh3f file")
    parser.add_argument("--out", type=Path, default=Path("cfr_jax/cli/demo_views"))
    args = parser.parse_args()
    mesh, name, creator = fork_lift(args.package)
    rng = np.random.default_rng(SEED)
    surface = unit(mesh.points(DENSE, SEED).points)
    args.out.mkdir(parents=True, exist_ok=True)
    poses = {}
    for number in range(VIEWS):
        seen = view(surface, 360.0 * number / VIEWS, rng, POINTS, NOISE)
        pose = motions.motion(turned(rng.uniform(-TURN, TURN, 3)), rng.uniform(-SHIFT, SHIFT, 3))
        file = f"view{number}.ply"
        write_ply(args.out / file, motions.apply(motions.inverse(pose), seen))
        poses[file] = pose.tolist()
    (args.out / "poses.json").write_text(json.dumps({"poses": poses}, indent=1) + "\n")
    text = LICENSE.format(name=name, creator=creator, source=f"{LIBRARY}: {PIECE}", how=HOW)
    text = text.replace("# The demo pair", "# The demo views")
    text = text.replace("`source.ply` and `target.ply` are two", f"The files here are {VIEWS}")
    text = text.replace("make_demo_pair.py", "make_demo_views.py")
    (args.out / "LICENSE.md").write_text(text)


if __name__ == "__main__":
    main()
