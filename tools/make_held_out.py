"""Makes the shapes for `cfr reproduce` from CC0 models in Debian.

    apt-get download sweethome3d-furniture && python tools/make_held_out.py *.deb

They are the CC0 shapes in the open corpus' `test.h5`, whose categories no network was trained on.
All of them come from the library BlendSwap-CC-0. Points and normals are sampled as for the corpus,
and stored as integers.
"""

from __future__ import annotations

import argparse
import io
import tempfile
from pathlib import Path

import numpy as np

from cfr_jax.data.making.furniture import FurnitureLibrary
from cfr_jax.data.making.open_cad import UNSEEN, category_of
from cfr_jax.data.making.packages import extract
from cfr_jax.data.making.shapes import make_shape
from cfr_jax.runtime.atomic import write_atomically

LIBRARY = "usr/share/sweethome3d/furniture/BlendSwap-CC-0.sh3f"
STEM = "BlendSwap-CC-0"
POINTS = 2048
# The pieces of the library that are in test.h5. Other pieces of these categories were left out
# there because they are flat, copies, or near copies of training shapes.
PIECES = (
    "armchair bidet chair chair2 couch2 designChair desklamp forkLift glassDoorCabinet lamp2 "
    "modernVanity outdoorLamp plasticChair relaxChair shower showerDoor silla2 sillaBlanca sofa2 "
    "stool stool2 toiletBrush toiletPaperDispenser wallLight"
).split()

CREDITS = """\
# The held-out shapes

`held_out.npz` holds {count} point clouds, sampled from models that their authors released on
blendswap.com under CC0 1.0 (public domain dedication,
https://creativecommons.org/publicdomain/zero/1.0/). The models come from
`{library}` in Debian's package
`sweethome3d-furniture` 1.8-1. The point clouds are also released under CC0 1.0.

`tools/make_held_out.py` made the file. Each shape has {points} points, sampled uniformly by area,
with the normals of their faces, centered and scaled into the unit sphere. Coordinates are stored as
int16 (times 32767), normals as int8 (times 127). The shipped weights were not trained on any of
these categories.

| shape | category | author |
|---|---|---|
"""


def main() -> None:
    """Writes `held_out.npz` and `held_out.md`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("package", type=Path, help="sweethome3d-furniture_*.deb or the .sh3f file")
    parser.add_argument("--out", type=Path, default=Path("cfr_jax/weights/shipped"))
    args = parser.parse_args()

    shapes, categories, credits = [], [], CREDITS.format(
        count=len(PIECES), library=LIBRARY, points=POINTS
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        library = args.package
        if library.suffix == ".deb":
            (library,) = extract(library, lambda name: name == LIBRARY, Path(folder), quiet=True)
        with FurnitureLibrary(library) as opened:
            pieces = {piece.identifier: piece for piece in opened.pieces}
            for name in PIECES:
                piece = pieces[f"Blend Swap CC-0#{name}"]
                path = f"{STEM}/{piece.identifier}"
                category = category_of("furniture", f"{path}|{piece.name}|{piece.category}")
                if category not in UNSEEN:
                    raise SystemExit(f"{path} is of {category}, which is not an unseen category")
                mesh = opened.mesh(piece)
                shapes.append(make_shape(mesh, f"sweethome3d:{path}", POINTS, least_faces=20))
                categories.append(category)
                credits += f"| {piece.name} (`{name}`) | {category} | {piece.creator} |\n"
    arrays = {
        "points": np.round(np.stack([shape.points for shape in shapes]) * 32767).astype(np.int16),
        "normals": np.round(np.stack([shape.normals for shape in shapes]) * 127).astype(np.int8),
        "names": np.array(PIECES),
        "categories": np.array(categories),
    }
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    for path, content in (
        (args.out / "held_out.npz", stream.getvalue()),
        (args.out / "held_out.md", credits.encode()),
    ):
        write_atomically(path, content)
        print(f"wrote {path} ({len(content) / 1e3:.0f} kB)")


if __name__ == "__main__":
    main()
