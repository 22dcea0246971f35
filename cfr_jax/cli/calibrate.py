"""`cfr calibrate`: fits the confidence of weights to pairs whose motion is known."""

from __future__ import annotations

import argparse
from pathlib import Path

from cfr_jax.cli.shared import outputs
from cfr_jax.cli.shared.commands import Commands
from cfr_jax.cli.shared.numbers import not_negative, positive

PAIRS = 500

_DESCRIPTION = """\
The confidence of an answer is the probability that it is right to 5 degrees and a tenth of the
clouds' radius. How the signs of a right answer translate into a probability depends on the weights.
So this command registers pairs with known motions, and fits the confidence to which answers are
right. Weights that train.py has just made have no confidence yet:

  cfr calibrate runs/parts/weights.safetensors --data corpus/val.h5 --out parts.safetensors
  cfr register a.ply b.ply --weights parts.safetensors

The new file holds the same weights and notes, plus the coefficients.

Use data that the weights were not trained on: a corpus of shapes (`cfr data build`), from which
pairs of all kinds are made, or pairs of your own: a CSV list `source,target,` and the 16 numbers of
the motion from source onto target, row by row, or an HDF5 file of pairs. Some of those are rotated
or halved, because the fit needs wrong answers, too.

A second call measures how well the confidence holds on other data, and fits nothing:

  cfr calibrate parts.safetensors --data corpus/test.h5 --check --figure reliability.png

Each pair takes about a second on a CPU.
"""


def add_parser(commands: Commands) -> None:
    """Adds `cfr calibrate`."""
    parser = commands.add_parser(
        "calibrate",
        help="fit the confidence of your own weights",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.set_defaults(run=run)
    parser.add_argument(
        "weights", metavar="WEIGHTS", help="a .safetensors file, or the name of shipped weights"
    )
    parser.add_argument(
        "--data",
        metavar="PAIRS_OR_CORPUS",
        type=Path,
        required=True,
        help="pairs with known motions, or shapes to make pairs from",
    )
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "--out", metavar="NEW.safetensors", type=Path, help="where to write the calibrated weights"
    )
    what.add_argument(
        "--check", action="store_true", help="only measure the confidence that the weights have"
    )
    parser.add_argument(
        "--pairs",
        metavar="N",
        type=positive,
        default=PAIRS,
        help=f"how many pairs to make from the data (default: {PAIRS})",
    )
    parser.add_argument(
        "--seed", metavar="N", type=not_negative, default=0, help="which ones (default: 0)"
    )
    parser.add_argument(
        "--keep",
        metavar="FILE.npz",
        type=Path,
        help="keep the findings for each pair here; an interrupted run continues from it",
    )
    parser.add_argument(
        "--figure",
        metavar="FILE.png",
        type=Path,
        help="draw how well the confidence holds (needs matplotlib)",
    )


def run(args: argparse.Namespace) -> int:
    """Registers the pairs, then fits or measures."""
    _check(args)

    from cfr_jax import __version__
    from cfr_jax.cli.shared.cache import keep_compiled_programs
    from cfr_jax.evaluation.calibration import fitting, reliability, trials
    from cfr_jax.networks.probability import KEY, calibration_of
    from cfr_jax.runtime.progress import Progress
    from cfr_jax.weights.files import read_weights, save_params

    weights = read_weights(args.weights, "cfr")
    calibration = calibration_of(weights.params)
    if args.check and calibration is None:
        raise ValueError(
            f"WEIGHTS: {args.weights} has no calibration to check; give --out to fit one"
        )
    opened = trials.open_trials(args.data, args.seed)
    keep_compiled_programs()
    with Progress(total=args.pairs, desc="registering", unit=" pairs") as bar:
        found = fitting.gather(
            weights.params,
            opened,
            args.pairs,
            kept=args.keep,
            made_of=f"{weights.sha256} {args.data.resolve()} {args.seed}",
            told=bar.update,
        )
    fitting.check_enough(found)
    if args.check and calibration is not None:
        chances = {name: fitting.predicted(calibration, found, name) for name in found.right}
    else:
        calibration = fitting.fit_calibration(found)
        chances = {name: fitting.cross_validated(found, name) for name in found.right}
        print("fitted; the following is measured by cross-validation, on shapes or pairs left out:")
    curves = {name: (chances[name], right) for name, right in found.right.items()}
    for name, curve in curves.items():
        print(f"{name:<11} {reliability.in_words(reliability.summary(*curve))}")
    if args.figure is not None:
        reliability.draw(args.figure, curves)
        print(f"wrote       {args.figure}")
    if args.out is not None:
        notes = weights.notes | {
            "calibrated_on": f"{args.pairs} pairs of {args.data.name}, seed {args.seed}",
            "calibrated_by": f"cfr_jax {__version__}",
        }
        save_params(args.out, {**weights.params, KEY: calibration}, notes)
        print(f"wrote       {args.out}")
        print(f"sha256      {read_weights(args.out).sha256}")
    return 0


def _check(args: argparse.Namespace) -> None:
    """Checks the arguments, as far as that needs no imports."""
    written = []
    if args.out is not None:
        outputs.check_output("--out", args.out, (".safetensors",))
        written.append(args.out)
    if args.keep is not None:
        outputs.check_output("--keep", args.keep, (".npz",))
        written.append(args.keep)
    if args.figure is not None:
        outputs.check_output("--figure", args.figure, outputs.PICTURE_SUFFIXES)
        outputs.check_library("--figure", args.figure)
        written.append(args.figure)
    outputs.check_apart([args.data, Path(args.weights)], written)
