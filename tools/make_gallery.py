"""Redraws docs/images/gallery: registers the scans of a folder and keeps the pictures.

    python tools/make_gallery.py SCANS --out docs/images/gallery

SCANS holds the files that docs/gallery.md names. For a pair of two scans, this runs the command of
that page. If there is one scan only, it is first cut in two: each half of the points, drawn at
random, keeps the first or the last 70 % along an axis, so that the two parts share a region and not
a single point. One part is turned by 30 degrees. The two parts are written to SCANS, and the motion
between them is known. A line with the figures is printed for each pair.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from PIL import Image

from cfr_jax import io
from cfr_jax.geometry import motions

_SHARE = 0.7  # of the scan along the axis, in each part: the two share 0.4
_TURN = np.deg2rad(30.0)
_AXIS = np.array([0.2, 0.3, 1.0])  # mostly about z, as scans are turned
_MOST_POINTS = 60_000  # of a scan that is cut
_WIDTH, _COLORS = 1000, 48  # pixels and palette of a picture that a page shows


@dataclass(frozen=True)
class Pair:
    """Files to register. Without a `target`, the source is cut along `axis`."""

    source: str
    target: str | None = None
    axis: int = 0


PAIRS = {
    "bunny": Pair("bun4.pcd", "bun0.pcd"),
    "street": Pair("source.ply", "target.ply"),
    "dinosaur": Pair("parasaurolophus_low_normals2.ply", "rs1_normals.ply"),
    "rearranged": Pair("rs22_proc2.ply", "rs1_normals.ply"),
    "milk": Pair("milk.pcd", "milk_cartoon_all_small_clorox.pcd"),
    "office": Pair("office1.pcd"),
    "tree": Pair("point_cloud_example.txt", axis=2),
    "airborne": Pair("file_with_both_wkt_and_geotiff_vlrs.las"),
    "airplane": Pair("airplane.ply"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scans", type=Path, help="folder with the files")
    parser.add_argument("--out", type=Path, required=True, help="folder for the pictures")
    parser.add_argument("--only", choices=PAIRS, action="append", help="make this one only")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    for name in args.only or PAIRS:
        pair, truth = PAIRS[name], None
        files = [args.scans / pair.source, args.scans / (pair.target or "")]
        if pair.target is None:
            files = [args.scans / f"{name}_{part}.ply" for part in ("a", "b")]
            truth = cut(args.scans / pair.source, pair.axis, files)
        report, picture = args.scans / f"{name}.json", args.out / f"{name}.png"
        command = [sys.executable, "-m", "cfr_jax", "register", *map(str, files)]
        subprocess.run(
            [*command, "--json", str(report), "--png", str(picture)],
            check=True,
            stdout=subprocess.DEVNULL,
        )
        shrink(picture)
        print(row(name, json.loads(report.read_text("utf-8")), truth), flush=True)


def cut(scan: Path, axis: int, parts: list[Path]) -> Float64[np.ndarray, "4 4"]:
    """Writes two parts of a scan; returns the motion that lays the first on the second."""
    points = np.asarray(io.read(scan).points, np.float64)
    points = points - points.mean(axis=0)
    order = np.random.default_rng(0).permutation(len(points))[:_MOST_POINTS]
    halves = [points[half] for half in np.array_split(order, 2)]
    low, high = np.quantile(points[:, axis], [1 - _SHARE, _SHARE])
    first, last = halves[0][halves[0][:, axis] <= high], halves[1][halves[1][:, axis] >= low]
    turned = np.eye(4)
    turned[:3, :3] = motions.from_rotvec(_TURN * _AXIS / np.linalg.norm(_AXIS))
    io.write(parts[0], io.PointCloud(first @ turned[:3, :3]))
    io.write(parts[1], io.PointCloud(last))
    return turned


def shrink(picture: Path) -> None:
    """Makes the picture as small as a page needs: fewer pixels, and a palette."""
    with Image.open(picture) as image:
        height = round(image.height * _WIDTH / image.width)
        small = image.convert("RGB").resize((_WIDTH, height), Image.Resampling.LANCZOS)
    # This method keeps colors that are rare, such as those of a small source.
    way = Image.Quantize.MAXCOVERAGE
    small.quantize(_COLORS, way, dither=Image.Dither.NONE).save(picture, optimize=True)


def row(name: str, report: dict, truth: Float64[np.ndarray, "4 4"] | None) -> str:
    """What the answer says of itself, and how far it is off where the truth is known."""
    verdict = "trusted" if report["trusted"] else "not trusted"
    cells = [name, f"{report['confidence']:.2f}, {verdict}", f"{report['fitness']:.3f}"]
    if truth is None:
        cells.append("")
    else:
        off = np.linalg.inv(truth) @ np.array(report["transform"])
        angle = np.degrees(np.linalg.norm(motions.to_rotvec(off[:3, :3])))
        cells.append(f"{angle:.2f}°, {np.linalg.norm(off[:3, 3]):.3g}")
    run, compiling = report["seconds"]["run"], report["seconds"]["compile"]
    cells += [f"{run:.1f} s", f"{compiling:.1f} s", "; ".join(report["warnings"])]
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
