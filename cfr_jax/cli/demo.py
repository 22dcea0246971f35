"""`cfr demo`: registers what ships with the package, whose true motions are known."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from cfr_jax.cli.shared import outputs
from cfr_jax.cli.shared.commands import Commands

if TYPE_CHECKING:
    import numpy as np

_DESCRIPTION = """\
Registers two views that ship with the package: an object as a depth camera would see it from two
places. Prints the motion, its quality, and its error against the known truth. Writes demo.png
(before and after) and demo.html (to rotate in a browser) into a folder.

With --merge, eight views around that object become one model, model.ply, shown in model.html.
"""
_VIEWS = Path(__file__).parent / "demo_views"
_PAIR = Path(__file__).parent / "demo_pair"


def add_parser(commands: Commands) -> None:
    """Adds `cfr demo`."""
    parser = commands.add_parser(
        "demo",
        help="register a pair that ships with the package, and show it",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.set_defaults(run=run)
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        default=Path("out"),
        help="folder for the pictures, created if missing (default: out)",
    )
    parser.add_argument(
        "--merge", action="store_true", help="merge eight views instead of registering two"
    )


def run(args: argparse.Namespace) -> int:
    """Registers the pair, or merges the views; prints how good the result is, and draws it."""
    if args.merge:
        return _merge(args.out)
    page, picture = args.out / "demo.html", args.out / "demo.png"
    args.out.mkdir(parents=True, exist_ok=True)
    for path in (page, picture):
        outputs.check_output("--out", path)

    import numpy as np

    from cfr_jax import io, viewer
    from cfr_jax.cli.shared import report
    from cfr_jax.cli.shared.cache import keep_compiled_programs

    source, target = io.read(_PAIR / "source.ply"), io.read(_PAIR / "target.ply")
    truth = json.loads((_PAIR / "truth.json").read_text("utf-8"))
    keep_compiled_programs()
    result = report.register(source, target)
    errors = errors_in_words(
        result.alignment.transform, np.asarray(truth["transform"]), source.points
    )

    print(f"Two views of one object ({truth['object']}, {truth['licence']}), in meters.\n")
    print(report.as_text(result))
    for name, text in errors.items():
        print(f"{name:<11} {text}")
    scene = report.as_scene(result, facts=errors)
    viewer.write_page(page, scene)
    print(f"\nwrote       {page} (open it in a browser and rotate it)")
    if outputs.can_draw():
        viewer.write_picture(picture, scene)
        print(f"wrote       {picture}")
    else:
        print(f'left out    {picture}: pictures need matplotlib: pip install "cfr_jax[viz]"')
    return 0


def _merge(folder: Path) -> int:
    cloud, page = folder / "model.ply", folder / "model.html"
    folder.mkdir(parents=True, exist_ok=True)
    for path in (cloud, page):
        outputs.check_output("--out", path)

    from cfr_jax import io, viewer
    from cfr_jax.cli.shared.cache import keep_compiled_programs
    from cfr_jax.cli.shared.merged import as_layers, as_text
    from cfr_jax.geometry import motions
    from cfr_jax.multiway.merging import merge
    from cfr_jax.multiway.pose_files import read_poses

    keep_compiled_programs()
    files = sorted(_VIEWS.glob("*.ply"))
    names = [path.name for path in files]
    truth = read_poses(_VIEWS / "poses.json", names)
    print("Eight views all around a forklift, each turned its own way.\n")
    merged = merge(files, progress=True)
    print(as_text(merged))
    if merged.clouds:
        first = motions.inverse(truth[names[merged.references[0]]])
        angles = [
            float(motions.angle_between(pose, first @ truth[names[index]]))
            for index, pose, component in zip(
                merged.placed.tolist(), merged.poses, merged.component.tolist(), strict=True
            )
            if component == 0
        ]
        print(f"error       {max(angles):.2f}° at most, against the known poses")
        io.write(cloud, merged.clouds[0].as_cloud())
        viewer.write_layers(page, as_layers(merged), title="forklift")
        print(f"\nwrote       {cloud}\nwrote       {page} (open it in a browser and rotate it)")
    return 0


def errors_in_words(estimate: np.ndarray, truth: np.ndarray, points: np.ndarray) -> dict[str, str]:
    """How far (4, 4) `estimate` is from (4, 4) `truth` for (n, 3) `points` of the source."""
    import numpy as np

    from cfr_jax.evaluation import metrics
    from cfr_jax.geometry import motions

    rotation = metrics.err_r(estimate[None], truth[None])[0]
    translation = metrics.err_t(estimate[None], truth[None])[0]
    difference = estimate - truth
    offsets = np.linalg.norm(motions.apply(difference, points), axis=1)
    return {
        "error": f"{rotation:.2f}° in rotation, {translation:.4f} m in translation",
        "points off": f"{offsets.mean():.4f} m on average",
    }
