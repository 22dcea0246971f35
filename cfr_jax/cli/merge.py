"""`cfr merge SCANS --out model.ply`: many scans of one thing become one model."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cfr_jax.cli.shared import flags, numbers, outputs, resuming
from cfr_jax.cli.shared.commands import Commands
from cfr_jax.io import formats

if TYPE_CHECKING:
    from cfr_jax.multiway.answers import Merged


_DESCRIPTION = """\
Lays many scans of one thing together: registers pairs of them, drops what contradicts the rest,
solves for all poses at once, refines them together, and writes one cloud.

SCANS are files or folders, in natural order (scan2 before scan10). All pairs are tried, or with
--sequence only neighbors. Scans may lie up to about 45 degrees about each axis from each other;
--global tries those that found no place from all rotations, too. A scan without a sure place is
left out and named, and so is a file that cannot be read. Scans that hang together, but not with the
rest, become models of their own: model.2.ply and so on.

Beside the model, a journal (model.pairs.jsonl) keeps every pair that is registered. After a crash,
a kill or Ctrl-C, run the same command again, and it continues where it stopped. With more scans,
only the new pairs are registered.
"""

_EPILOG = """\
poses:
  .json         all that is known: poses, covariances, edges, what was left out
  .txt .kitti   KITTI: 12 numbers a line     .tum   TUM: time x y z qx qy qz qw
  images.txt    COLMAP                       .conf  the Stanford repository

examples:
  cfr merge scans/ --out model.ply
  cfr merge scans/*.ply --out model.ply --voxel 0.002 --poses poses.json --view page.html
  cfr merge drive/*.bin --out map.ply --sequence --loop-closures --poses poses.txt
  cfr merge bun*.ply --out bunny.ply --initial bun.conf
  cfr merge scans/ --out model.ply --shard 2/4    registers the second quarter of the pairs, on
                                                  one of four machines; without it: all together
"""


def add_parser(commands: Commands) -> None:
    """Adds `cfr merge`."""
    parser = commands.add_parser(
        "merge",
        help="merge many scans of one thing into one model",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.set_defaults(run=run)
    parser.add_argument("scans", metavar="SCANS", type=Path, nargs="+", help="files and folders")
    parser.add_argument(
        "--out",
        metavar="FILE",
        type=Path,
        required=True,
        help=f"the merged cloud, required ({' '.join(outputs.cloud_suffixes())})",
    )
    parser.add_argument("--poses", metavar="FILE", type=Path, help="the poses (formats: below)")
    parser.add_argument(
        "--view", metavar="PAGE.html", type=Path, help="a page that shows the scans from all sides"
    )
    parser.add_argument(
        "--voxel",
        metavar="V",
        type=numbers.positive_real,
        help="one point for each cube of this size (default: the spacing of the scans' points)",
    )
    flags.add_strict(parser, "a scan was left out, or there are several models")
    _add_pairs(parser)
    how = parser.add_argument_group("how to register")
    flags.add(how, "--weights", "--max-points", "--seed", "--workers")


def _add_pairs(parser: argparse.ArgumentParser) -> None:
    which = parser.add_argument_group("which pairs to register")
    which.add_argument(
        "--sequence", action="store_true", help="each scan with the next two, not with all"
    )
    which.add_argument(
        "--loop-closures",
        action="store_true",
        help="then also those that overlap where the poses lay them",
    )
    which.add_argument(
        "--global",
        dest="everywhere",
        action="store_true",
        help="try scans without a place from all rotations",
    )
    which.add_argument(
        "--initial", metavar="FILE", type=Path, help="poses to start from (formats: below)"
    )
    flags.add(which, "--shard", "--retry-failed")


def run(args: argparse.Namespace) -> int:
    """Checks the arguments, merges, and writes; what is registered is kept on the way."""
    files = _files(args.scans)
    written = _checked_outputs(args, files)

    from cfr_jax.cli.shared.cache import keep_compiled_programs
    from cfr_jax.multiway import merging
    from cfr_jax.multiway.scans import names_of

    keep_compiled_programs()
    weights = flags.weights_of(args.weights)
    guesses = None if args.initial is None else _guesses(args.initial, names_of(files))
    made_with = {
        "weights": weights.sha256,
        "max_points": args.max_points,
        "seed": args.seed,
        "initial": _digest(args.initial),
    }
    share = resuming.asked_share(args.shard)
    kept = args.out.with_suffix(".pairs.jsonl")
    if share is not None:
        kept = share.beside(kept)
    outputs.check_output("--out", kept)
    outputs.check_apart(files, [kept, *written])
    print(f"scans       {len(files)}")
    options: dict[str, Any] = {
        "params": weights.params,
        "sequence": args.sequence,
        "guesses": guesses,
        "max_points": args.max_points,
        "seed": args.seed,
        "workers": args.workers,
        "progress": True,
    }
    with resuming.journal(kept, made_with, share, args) as journal:
        if before := len(list(journal)):
            print(f"done before {before} pairs")
        if share is not None:
            count = merging.register_share(files, share.rows(), kept=journal, **options)
            print(f"registered  {count} pairs, share {share.number} of {share.count}")
            print(f"wrote       {kept}")
            return 0
        found = merging.merge(
            files,
            everywhere=args.everywhere,
            loop_closures=args.loop_closures,
            voxel=args.voxel,
            kept=journal,
            **options,
        )
    return _tell(found, args, kept)


def _checked_outputs(args: argparse.Namespace, files: list[Path]) -> list[Path]:
    """The files that the options name, which can all be written."""
    outputs.check_output("--out", args.out, outputs.cloud_suffixes())
    if args.poses is not None:
        from cfr_jax.multiway.pose_files import SUFFIXES

        outputs.check_output("--poses", args.poses, SUFFIXES)
    if args.view is not None:
        outputs.check_output("--view", args.view, outputs.PAGE_SUFFIXES)
    written = [path for path in (args.out, args.poses, args.view) if path is not None]
    outputs.check_apart([*files, *filter(None, [args.initial])], written)
    return written


def _files(given: list[Path]) -> list[Path]:
    """The scans, folders opened, each file once."""
    from cfr_jax.data.folders import loose_files

    files: list[Path] = []
    for path in given:
        if not path.exists():
            raise ValueError(f"SCANS: there is no file or folder {path}")
        files += loose_files(path, formats.of_clouds()) if path.is_dir() else [path]
    files = list(dict.fromkeys(files))
    if len(files) < 2:
        raise ValueError(f"SCANS: found {len(files)} scans, wanted at least two")
    return files


def _guesses(path: Path, names: Sequence[str]) -> list[Any]:
    """The poses in a file, one or None for each scan."""
    from cfr_jax.multiway.pose_files import read_poses

    held = read_poses(path, names)
    print(f"initial     poses of {len(held)} of {len(names)} scans")
    return [held.get(name) for name in names]


def _digest(path: Path | None) -> str | None:
    import hashlib

    return None if path is None else hashlib.sha256(path.read_bytes()).hexdigest()


def _tell(found: Merged, args: argparse.Namespace, kept: Path) -> int:
    from cfr_jax import io
    from cfr_jax.cli.shared import merged

    written = []
    for number, cloud in enumerate(found.clouds):
        path = args.out if not number else args.out.with_suffix(f".{number + 1}{args.out.suffix}")
        io.write(path, cloud.as_cloud(args.out.stem))
        written.append(path)
    if args.poses is not None:
        merged.write_poses(args.poses, found)
        written.append(args.poses)
    if args.view is not None and found.clouds:
        from cfr_jax.viewer import write_layers

        write_layers(args.view, merged.as_layers(found), title=args.out.stem)
        written.append(args.view)
    print(merged.as_text(found))
    for path in (*written, kept):
        print(f"wrote       {path}")
    if not found.clouds:
        raise ValueError(
            "no scan has a sure place, so there is no model; --poses FILE.json has every pair\n"
            "scans turned far need --global"
        )
    complete = not found.left_out and len(found.references) == 1
    return flags.UNSURE if args.strict and not complete else 0
