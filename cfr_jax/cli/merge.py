"""`cfr merge SCANS --out model.ply`: many scans of one thing become one model."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cfr_jax.cli.shared import numbers, outputs
from cfr_jax.cli.shared.commands import Commands
from cfr_jax.io import formats

if TYPE_CHECKING:
    from cfr_jax.multiway.answers import Merged
    from cfr_jax.viewer import Layer

INCOMPLETE = 3
FORMAT = "cfr_jax/poses/1"
POSE_SUFFIXES = (".json", ".txt", ".kitti", ".tum", ".conf")

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
        help="many scans of one thing into one model, and the pose of each",
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
        help=f"the merged cloud ({' '.join(outputs.cloud_suffixes())})",
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
    parser.add_argument(
        "--strict",
        action="store_true",
        help=f"exit with {INCOMPLETE} if a scan was left out, or there are several models",
    )
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
    which.add_argument("--shard", metavar="I/N", help="register only this share of the pairs")
    which.add_argument(
        "--retry-failed", action="store_true", help="retry the pairs that failed before"
    )
    how = parser.add_argument_group("how to register")
    how.add_argument("--weights", metavar="W", help="a shipped name, or a .safetensors file")
    how.add_argument(
        "--max-points", metavar="N", type=numbers.positive, help="most points of each cloud"
    )
    how.add_argument(
        "--seed", metavar="S", type=numbers.not_negative, default=0, help="of the choice of points"
    )
    how.add_argument("--workers", metavar="N", type=numbers.positive, help="threads that prepare")


def run(args: argparse.Namespace) -> int:
    """Checks the arguments, merges, and writes; what is registered is kept on the way."""
    files = _files(args.scans)
    written = [path for path in (args.out, args.poses, args.view) if path is not None]
    outputs.check_output("--out", args.out, outputs.cloud_suffixes())
    if args.poses is not None:
        outputs.check_output("--poses", args.poses, POSE_SUFFIXES)
    if args.view is not None:
        outputs.check_output("--view", args.view, outputs.PAGE_SUFFIXES)
    outputs.check_apart([*files, *filter(None, [args.initial])], written)

    from cfr_jax.batch.journal import Journal
    from cfr_jax.batch.sharding import other_shards
    from cfr_jax.cli.shared.cache import keep_compiled_programs
    from cfr_jax.cli.shared.shares import asked_share
    from cfr_jax.multiway import merging
    from cfr_jax.multiway.pose_files import read_poses
    from cfr_jax.multiway.scans import names_of
    from cfr_jax.weights.files import DEFAULT, read_weights

    keep_compiled_programs()
    weights = read_weights(DEFAULT if args.weights is None else args.weights, "cfr")
    names = names_of(files)
    guesses = None
    if args.initial is not None:
        held = read_poses(args.initial, names)
        guesses = [held.get(name) for name in names]
        print(f"initial     poses of {len(held)} of {len(names)} scans")
    made_with = {
        "weights": weights.sha256,
        "max_points": args.max_points,
        "seed": args.seed,
        "initial": _digest(args.initial),
    }
    share = asked_share(args.shard)
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
    with Journal(kept, made_with, retry=args.retry_failed, command="merge") as journal:
        for other in other_shards(kept) if share is None else ():
            journal.adopt(other, made_with)
        if before := len(list(journal)):
            print(f"done before {before} pairs")
        try:
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
        except KeyboardInterrupt:
            print(
                f"cfr merge: stopped; {kept} keeps what is registered\n"
                "run the same command again to continue",
                file=sys.stderr,
            )
            raise
    return _tell(found, args, kept)


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


def _digest(path: Path | None) -> str | None:
    import hashlib

    return None if path is None else hashlib.sha256(path.read_bytes()).hexdigest()


def _tell(found: Merged, args: argparse.Namespace, kept: Path) -> int:
    from cfr_jax import io

    written = []
    for number, cloud in enumerate(found.clouds):
        path = args.out if not number else args.out.with_suffix(f".{number + 1}{args.out.suffix}")
        io.write(path, cloud.as_cloud(args.out.stem))
        written.append(path)
    if args.poses is not None:
        _write_poses(found, args.poses)
        written.append(args.poses)
    if args.view is not None and found.clouds:
        from cfr_jax.viewer import write_layers

        write_layers(args.view, as_layers(found), title=args.out.stem)
        written.append(args.view)
    print(as_text(found))
    for path in (*written, kept):
        print(f"wrote       {path}")
    if not found.clouds:
        raise ValueError(
            "no scan has a sure place, so there is no model; --poses FILE.json has every pair\n"
            "scans turned far need --global"
        )
    complete = not found.left_out and len(found.references) == 1
    return INCOMPLETE if args.strict and not complete else 0


def _write_poses(found: Merged, path: Path) -> None:
    from cfr_jax.multiway.pose_files import write_poses
    from cfr_jax.runtime.atomic import write_atomically

    if path.suffix.lower() == ".json":
        text = json.dumps(as_document(found), indent=1, allow_nan=False)
        write_atomically(path, (text + "\n").encode())
        return
    # such files know one frame, so they get the poses of the largest model
    poses = {
        found.names[index]: pose
        for index, pose, component in zip(
            found.placed.tolist(), found.poses, found.component.tolist(), strict=True
        )
        if component == 0
    }
    write_poses(path, poses, found.names)


def as_layers(found: Merged) -> list[Layer]:
    """The points of the largest model, one layer for each scan, under its name."""
    from cfr_jax.viewer import Layer

    if not found.clouds:
        return []
    model = found.clouds[0]
    return [
        Layer(found.names[scan], model.points[model.scan == scan])
        for scan in sorted(set(model.scan.tolist()))
    ]


def as_text(found: Merged) -> str:
    """The summary for people."""
    kept = [edge for edge in found.edges if edge.kept]
    lines = [
        f"registered  {len(found.edges)} pairs, of these {len(kept)} agree with the poses",
        f"placed      {len(found.placed)} of {len(found.names)} scans",
    ]
    for number, rows in found.by_component():
        reference = found.names[found.references[number]]
        size = f", {len(found.clouds[number].points):,} points" if found.clouds else ""
        name = "model" if not number else f"model {number + 1}"
        lines.append(f"{name:<11} {len(rows)} scans in the frame of {reference}{size}")
    lines += [f"left out    {each.name}: {each.reason}" for each in found.left_out]
    lines += [f"note        {note}" for note in found.notes]
    lines.append(f"time        {found.seconds['total']:.1f} s")
    return "\n".join(lines)


def as_document(found: Merged) -> dict[str, Any]:
    """Everything that is known, in the form of `merge.schema.json`."""
    from cfr_jax import __version__

    def number(value: float) -> float | None:
        return value if value == value else None

    return {
        "format": FORMAT,
        "version": __version__,
        "poses": {
            found.names[index]: pose.tolist()
            for index, pose in zip(found.placed.tolist(), found.poses, strict=True)
        },
        "covariances": {
            found.names[index]: spread.tolist()
            for index, spread in zip(found.placed.tolist(), found.covariances, strict=True)
        },
        "models": [
            {
                "reference": found.names[found.references[number_]],
                "scans": [found.names[index] for index in found.placed[rows].tolist()],
            }
            for number_, rows in found.by_component()
        ],
        "left_out": {each.name: each.reason for each in found.left_out},
        "notes": list(found.notes),
        "edges": [
            {
                "source": found.names[edge.source],
                "target": found.names[edge.target],
                "transform": edge.transform.tolist(),
                "confidence": edge.confidence,
                "kept": edge.kept,
                "reason": edge.reason,
                "residual": number(edge.residual),
                "distance": number(edge.distance),
            }
            for edge in found.edges
        ],
        "seconds": found.seconds,
    }
