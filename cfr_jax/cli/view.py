"""`cfr view RESULT.json`: draws a registration that was saved before."""

from __future__ import annotations

import argparse
from pathlib import Path

from cfr_jax.cli.shared import clouds, outputs
from cfr_jax.cli.shared.commands import Commands

_DESCRIPTION = """\
Draws a result that `cfr register --json` wrote, without registering again:

  cfr register a.ply b.ply --json result.json
  cfr view result.json                                      writes result.html, beside the result
  cfr view result.json --out page.html --out before_after.png
  cfr view result.json --out scene.rrd && rerun scene.rrd   (pip install "cfr_jax[rerun]")

The two clouds are read again from where they were; if they have been moved, --source and --target
say where they are now. A page is one file that loads nothing from the network; a PNG needs no
display (pip install "cfr_jax[viz]"). Correspondence weights are not saved with a result: `cfr
register --view` shows them.
"""


def add_parser(commands: Commands) -> None:
    """Adds `cfr view`."""
    parser = commands.add_parser(
        "view",
        help="draw a saved result",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.set_defaults(run=run)
    parser.add_argument(
        "result", metavar="RESULT.json", type=Path, help="what `cfr register --json` wrote"
    )
    parser.add_argument(
        "--out",
        metavar="FILE",
        type=Path,
        action="append",
        help=f"what to write, by its suffix ({' '.join(outputs.VIEW_SUFFIXES)}); may be given more "
        "than once (default: the name of the result, with .html)",
    )
    for role in ("source", "target"):
        parser.add_argument(f"--{role}", metavar="FILE", type=Path, help=f"where the {role} is now")


@clouds.telling("cfr view")
def run(args: argparse.Namespace) -> int:
    """Reads the result and its clouds, and draws them."""
    wanted = args.out or [args.result.with_suffix(".html")]
    if not args.out and wanted[0].exists():
        # perhaps the page of `cfr register --view`, which shows more
        raise ValueError(f"{wanted[0]} already exists: name the file to write with --out")
    for path in wanted:
        outputs.check_output("--out", path, outputs.VIEW_SUFFIXES)
        outputs.check_library("--out", path)
    given = [path for path in (args.result, args.source, args.target) if path is not None]
    outputs.check_apart(given, wanted)

    from cfr_jax.cli.shared import saved

    document = saved.read_result(args.result)
    paths = {
        role: saved.find_cloud(document, role, args.result, getattr(args, role))
        for role in ("source", "target")
    }
    outputs.check_apart(paths.values(), wanted)
    scene = saved.as_scene(document, **saved.read_clouds(document, paths))
    outputs.draw(scene, wanted)
    for text in scene.warnings:
        print(f"warning     {text}")
    for path in wanted:
        print(f"wrote       {path}")
    return 0
