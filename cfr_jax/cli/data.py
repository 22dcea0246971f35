"""`cfr data`: builds and shows corpora of shapes."""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cfr_jax.cli.shared import outputs
from cfr_jax.cli.shared.commands import Commands
from cfr_jax.data.making.mesh_formats import mesh_formats
from cfr_jax.io.formats import in_words

if TYPE_CHECKING:
    from cfr_jax.data.making.build import Report

_DESCRIPTION = """\
Builds the corpora that networks are trained and tested on, and shows what a corpus holds:

  cfr data open-cad --out open_cad             the open corpus, from four packages of Debian 12
  cfr data build meshes/ --out corpus/         your own meshes, one folder per category
  cfr data info corpus/train.h5 --sheet s.png  counts, and a picture of every category
"""

_BUILD = """\
Turns a folder of meshes into a corpus: 2048 points per shape, drawn by area, with the normals of
their faces, in the unit sphere. The first folder below FOLDER is the category. Damaged files, flat
shapes, shapes with fewer than 20 faces (a box has 12: --least-faces), and duplicates are left out;
left_out.txt, beside the corpus, names them. Meshes are files that end in
{suffixes}

  cfr data build meshes --out corpus --unseen lamp,seat      train.h5, val.h5, test.h5
  cfr data build meshes --out corpus --unseen all            test.h5 alone
  cfr data build meshes --out corpus.h5                      all shapes in one file
  cfr data build ModelNet40 --files "*/test/*" --out corpus  some of the meshes
  cfr data build psb/db --classes test.cla --out corpus      the Princeton Shape Benchmark

In a folder, test.h5 holds the unseen categories (half of them, by a hash of the name, unless you
name them), val.h5 a fifth of the other shapes (by a hash of the name), train.h5 the rest. The same
meshes give the same bytes. An interrupted build resumes.
"""

_OPEN_CAD = """\
Rebuilds the open corpus from Debian 12's packages 0ad-data, flightgear-data-models,
flightgear-data-ai and sweethome3d-furniture (1.9 GB): 24 seen categories in train.h5 and val.h5,
21 unseen ones in test.h5, every split by a rule on the shape's name. Needs 4 GB of disk while it
works, and about 10 minutes. An interrupted build resumes.

The meshes are under free licenses that ask for credit (and 0 A.D.'s for the same license):
CREDITS.md is written beside the files, keep it there.
"""

_INFO = """\
Says what FILE is, by its layout, and what a corpus holds: shapes by category, points per shape. A
corpus is an HDF5 file in the layout of modelnet40_ply_hdf5_2048, or a folder of them.
"""


def add_parser(subparsers: Commands) -> None:
    """Adds `cfr data` with its own commands."""
    style: dict[str, Any] = {
        "formatter_class": argparse.RawDescriptionHelpFormatter,
        "allow_abbrev": False,
    }
    parser = subparsers.add_parser(
        "data", help="build a corpus of shapes, or look at one", description=_DESCRIPTION, **style
    )
    commands = parser.add_subparsers(
        title="commands", dest="data_command", metavar="COMMAND", required=True
    )

    _add_build(commands, style)
    _add_open_cad(commands, style)
    _add_info(commands, style)


def _add_build(commands: Commands, style: dict[str, Any]) -> None:
    build = commands.add_parser(
        "build",
        help="build a corpus from a folder of meshes",
        description=_BUILD.format(suffixes=in_words(mesh_formats())),
        **style,
    )
    build.set_defaults(run=_build)
    build.add_argument("folder", metavar="FOLDER", type=Path, help="meshes, a folder per category")
    build.add_argument(
        "--out", metavar="DIR|FILE.h5", type=Path, required=True, help="the corpus (required)"
    )
    build.add_argument(
        "--unseen", metavar="A,B,...", help="categories for test.h5, or 'none', or 'all'"
    )
    build.add_argument(
        "--points", metavar="N", type=int, default=2048, help="points per shape (default: 2048)"
    )
    build.add_argument(
        "--least-faces",
        metavar="N",
        type=int,
        default=20,
        help="leave out meshes with fewer faces (default: 20)",
    )
    build.add_argument(
        "--files",
        metavar="PATTERN",
        default="*",
        help="take only meshes whose path below FOLDER is like this ('*/test/*')",
    )
    build.add_argument(
        "--classes",
        metavar="FILE.cla",
        type=Path,
        help="categories from a classification of the Princeton Shape Benchmark's form",
    )


def _add_open_cad(commands: Commands, style: dict[str, Any]) -> None:
    open_cad = commands.add_parser(
        "open-cad",
        help="build the open corpus from Debian's packages",
        description=_OPEN_CAD,
        **style,
    )
    open_cad.set_defaults(run=_open_cad)
    open_cad.add_argument(
        "--out", metavar="DIR", type=Path, required=True, help="the corpus (required)"
    )
    open_cad.add_argument(
        "--debs", metavar="DIR", type=Path, help="folder of the .deb files (default: ask apt)"
    )
    open_cad.add_argument(
        "--compare", metavar="DIR", type=Path, help="another build: report the differences"
    )


def _add_info(commands: Commands, style: dict[str, Any]) -> None:
    info = commands.add_parser("info", help="show what a corpus holds", description=_INFO, **style)
    info.set_defaults(run=_info)
    info.add_argument(
        "file", metavar="FILE", type=Path, help="any data: a corpus, pairs, scans, clouds, meshes"
    )
    info.add_argument(
        "--sheet", metavar="FILE.png", type=Path, help="a picture with shapes of every category"
    )


def _build(args: argparse.Namespace) -> int:
    for option, value, least in (
        ("--points", args.points, 16),
        ("--least-faces", args.least_faces, 1),
    ):
        if value < least:
            raise ValueError(f"{option}: got {value}, wanted at least {least}")
    single = args.out.suffix == ".h5"
    if single and args.unseen is not None:
        raise ValueError("--unseen: a single file has no test split; let --out be a folder")
    _check_place(args.out, single)

    from cfr_jax.data.making.build import build, choose_unseen
    from cfr_jax.data.making.items import folder_items

    items = folder_items(args.folder, args.least_faces, args.files, args.classes)
    categories = [item.category for item in items]
    unseen: tuple[str, ...] | None = None
    if not single and args.unseen is None:
        unseen = choose_unseen(categories)
    elif not single:
        chosen = {"none": [], "all": sorted(set(categories))}
        unseen = tuple(chosen.get(args.unseen, args.unseen.split(",")))
    _print_report(build(items, args.out, unseen, args.points), args.out)
    return 0


def _open_cad(args: argparse.Namespace) -> int:
    _check_place(args.out, single=False)
    if args.debs is not None and not args.debs.is_dir():
        raise ValueError(f"--debs: there is no folder {args.debs}")
    if args.compare is not None and not any(args.compare.glob("*.h5")):
        raise ValueError(f"--compare: no .h5 file in {args.compare}")

    import json

    from cfr_jax.data.making.difference import compare
    from cfr_jax.data.making.open_cad import build_open_cad

    _print_report(build_open_cad(args.out, args.debs), args.out)
    if args.compare is not None:
        comparison = compare(args.out, args.compare)
        report = args.out / "comparison.json"
        report.write_text(json.dumps(comparison.asdict(), indent=1) + "\n")
        print(comparison)
        print(f"wrote       {report}")
    return 0


def _info(args: argparse.Namespace) -> int:
    if args.sheet is not None:
        outputs.check_output("--sheet", args.sheet, outputs.PICTURE_SUFFIXES)
        if not outputs.can_draw():
            raise ValueError('--sheet: pictures need matplotlib: pip install "cfr_jax[viz]"')

    from cfr_jax.data.corpus import read_corpus
    from cfr_jax.data.layout import recognize

    if args.file.exists() and (layout := recognize(args.file)).kind.read_shapes is None:
        if args.sheet is not None:
            raise ValueError(f"--sheet: {layout}, wanted a corpus of shapes")
        print(layout)
        return 0
    corpus = read_corpus(args.file)
    counts = Counter(corpus.categories[label] for label in corpus.labels)
    print(f"{args.file}: {len(corpus)} shapes of {corpus.points.shape[1]} points")
    for category, count in sorted(counts.items()):
        print(f"{count:6d}  {category}")
    if args.sheet is not None:
        from cfr_jax.data.making.sheet import write_sheet

        write_sheet(args.sheet, corpus)
        print(f"wrote {args.sheet}")
    return 0


def _check_place(out: Path, single: bool) -> None:
    """Raises ValueError unless a corpus can be written to `out`, where it replaces an older one."""
    if single:
        outputs.check_output("--out", out, (".h5",))
    elif out.is_dir():
        outputs.check_output("--out", out / "train.h5")
    elif out.exists():
        raise ValueError(f"--out: {out} is a file, wanted a folder or a name that ends in .h5")
    else:
        outputs.check_output("--out", out)


def _print_report(report: Report, out: Path) -> None:
    for split, counts in report.counts.items():
        categories = sum(count > 0 for count in counts.values())
        print(f"{split:11s} {sum(counts.values())} shapes of {categories} categories")
    from cfr_jax.data.making.build import ENOUGH

    few = report.counts["val"].total() if "val" in report.counts else ENOUGH
    if few < ENOUGH and report.counts["train"].total():
        print(f"few         {few} shapes to validate on: with fewer than {ENOUGH}, the choice of")
        print("            the best weights depends on chance; try more meshes or another --unseen")
    for why, count in report.reasons.most_common():
        print(f"left out    {count}: {why}")
    print(f"wrote       {out}")
    if report.left_out:
        print(f"            {report.left_out_file}: the names of what was left out")
