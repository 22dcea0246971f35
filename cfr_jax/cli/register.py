"""`cfr register SOURCE TARGET`: finds the motion that lays one file on another."""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
from pathlib import Path
from typing import Any

from cfr_jax import refine
from cfr_jax.cli.shared import clouds, flags, outputs
from cfr_jax.cli.shared.commands import Commands
from cfr_jax.runtime import optional

_DESCRIPTION = """\
Finds the rigid motion that lays SOURCE on TARGET, and says how far to trust it.

The answer T is a 4x4 matrix in the unit and the frames of the two files: for a point x of SOURCE,
T @ [x; 1] lies on TARGET. The clouds may be of any size, unit and offset; they should show parts
of the same object or place, in the same unit. For different units, see --scale: then T maps the
scaled source.
"""

_EPILOG = """\
files:
{files}

what the quality means:
  fitness         share of the source's points that lie within the inlier distance of the target
  inlier RMSE     root mean square distance of those points, in the files' unit
  overlap         estimated share of the source that the target also saw
  confidence      probability, 0 to 1, that the motion is right to 5 degrees and a tenth of the
                  clouds' radius
  not determined  the shapes leave a motion open (a plane on a plane, a line, a sphere)
  nearly symmetric  (--global) the clouds fit about as well in another position, which is named
  not trusted     not determined, or more likely wrong than right: do not use it unchecked

examples:
  cfr register a.ply b.ply                             print the motion and its quality
  cfr register a.ply b.ply --out a_on_b.ply            write the source, moved onto the target
  cfr register a.pcd b.las --json - | jq .transform    use it in a script
  cfr register a.ply b.ply --view page.html            rotate the result in a browser
  cfr register a.ply b.ply --initial previous.json     start from an earlier answer
  cfr register a.ply b.ply --global                    if they may be rotated by any angle
  cfr register a.stl b.ply --scale auto                if they may have different units
  cfr register a.ply b.ply --strict || echo "look at it"
"""


def add_parser(commands: Commands) -> None:
    """Adds `cfr register`."""
    parser = commands.add_parser(
        "register",
        help="find the motion that lays one point cloud on another",
        description=_DESCRIPTION,
        epilog=_EPILOG.format(files=clouds.files_in_words()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.set_defaults(run=run)
    parser.add_argument("source", metavar="SOURCE", type=Path, help="the cloud that moves")
    parser.add_argument("target", metavar="TARGET", type=Path, help="the cloud that stays")
    _add_outputs(parser)
    _add_method(parser)


def _add_outputs(parser: argparse.ArgumentParser) -> None:
    written = parser.add_argument_group("what to write")
    written.add_argument(
        "--out",
        metavar="FILE",
        type=Path,
        help="the moved (and scaled) source with all that its file holds "
        f"({' '.join(outputs.cloud_suffixes())})",
    )
    written.add_argument(
        "--json",
        metavar="FILE",
        type=Path,
        help="the full report, as JSON; - writes it to standard output, and nothing else goes "
        "there",
    )
    written.add_argument(
        "--view",
        metavar="FILE",
        type=Path,
        action="append",
        help="the result to look at: .html is a page that shows it from all sides, .png a picture "
        'of before and after (pip install "cfr_jax[viz]"), .rrd a recording for Rerun; may be '
        "given more than once",
    )
    written.add_argument(  # its former name for pictures
        "--png", dest="view", type=Path, action="append", help=argparse.SUPPRESS
    )


def _add_method(parser: argparse.ArgumentParser) -> None:
    how = parser.add_argument_group("how to register")
    clouds.add_columns(how)
    after = how.add_mutually_exclusive_group()
    flags.add(after, "--no-refine")
    after.add_argument(
        "--refine",
        metavar="WAY",
        default=True,
        help="what refines the network's answer: "
        + "; ".join(f"{name}, {refine.named(name).title}" for name in refine.names())
        + f"; or module:function (default: {refine.DEFAULT})",
    )
    flags.add(how, "--weights")
    where = how.add_mutually_exclusive_group()
    where.add_argument(
        "--initial",
        metavar="FILE",
        type=Path,
        action="append",
        help="move the (scaled) source by the 4x4 matrix in this file first: .txt with 16 numbers, "
        ".npy, or .json (a matrix, or what --json wrote); the answer includes it; given several "
        "times, all are tried",
    )
    where.add_argument(
        "--global",
        dest="everywhere",
        action="store_true",
        help="search all rotations; without it, up to about 45 degrees about each axis are found",
    )
    where.add_argument(
        "--auto",
        action="store_true",
        help="search all rotations only if the answer is not trusted without",
    )
    flags.add(how, "--max-points", "--thinned")
    how.add_argument("--all-points", action="store_true", help=argparse.SUPPRESS)  # what it was
    flags.add(how, "--scale", "--no-second-look", "--seed")
    flags.add_strict(how, "the answer is not to be trusted; files are written anyway")


@clouds.telling("cfr register")
def run(args: argparse.Namespace) -> int:
    """Reads, registers and writes; what can be checked is checked before JAX is imported."""
    if args.all_points:
        raise ValueError("--all-points: all points are used without it; --thinned turns that off")
    to_stdout = args.json == Path("-")
    _check_outputs(args, to_stdout)

    import numpy as np

    from cfr_jax import io
    from cfr_jax.cli.shared.transforms import read_transform

    initial: Any = "global" if args.everywhere else "auto" if args.auto else None
    if args.initial is not None:
        motions = [read_transform(path) for path in args.initial]
        initial = motions[0] if len(motions) == 1 else np.stack(motions)
    columns = clouds.columns_of(args)
    source = io.read(
        args.source, seed=args.seed, columns=columns[0], properties=args.out is not None
    )
    target = io.read(args.target, seed=args.seed, columns=columns[1])

    from cfr_jax.cli.shared import report
    from cfr_jax.cli.shared.cache import keep_compiled_programs

    keep_compiled_programs()
    result = report.register(
        source,
        target,
        weights=args.weights,
        initial=initial,
        **flags.solving(args, args.refine),
    )
    if args.out is not None:
        io.write(args.out, result.moved_source())
    if args.json is not None:
        document = report.as_document(result, str(args.source), str(args.target))
        for role, names in zip(("source", "target"), columns, strict=True):
            if names is not None:
                document[role]["columns"] = list(names)
        _write_json(None if to_stdout else args.json, document)
    if args.view is not None:
        outputs.draw(report.as_scene(result), args.view)

    for warning in result.alignment.warnings if to_stdout else ():
        print(f"cfr register: warning: {warning}", file=sys.stderr)
    if not to_stdout:
        print(report.as_text(result))
        for path in filter(None, (args.out, args.json, *(args.view or ()))):
            print(f"wrote       {path}")
    return flags.UNSURE if args.strict and not result.alignment.trusted else 0


def _check_outputs(args: argparse.Namespace, to_stdout: bool) -> None:
    wanted = [
        ("--out", args.out, outputs.cloud_suffixes()),
        ("--json", None if to_stdout else args.json, ()),
        *(("--view", path, outputs.VIEW_SUFFIXES) for path in args.view or ()),
    ]
    given = [each for each in wanted if each[1] is not None]
    for option, path, suffixes in given:
        outputs.check_output(option, path, suffixes)
    inputs = [args.source, args.target, *(args.initial or ())]
    outputs.check_apart(inputs, [path for _, path, _ in given])
    chosen = refine.find(args.refine)
    library = None if chosen is None else chosen.library
    if library is not None and importlib.util.find_spec(library) is None:
        raise ValueError(f"--refine {args.refine} needs {library}: {optional.way_out(library)}")
    for path in args.view or ():
        outputs.check_library("--view", path)


def _write_json(path: Path | None, document: dict) -> None:
    from cfr_jax.runtime.atomic import write_atomically

    text = json.dumps(document, indent=2, allow_nan=False) + "\n"
    if path is None:
        sys.stdout.write(text)
    else:
        write_atomically(path, text.encode())
