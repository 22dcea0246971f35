"""`cfr reproduce NAME`: measures shipped weights again, on shapes that also ship."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from cfr_jax.cli import models
from cfr_jax.cli.shared import outputs
from cfr_jax.cli.shared.commands import Commands

FORMAT = "cfr_jax/reproduce/1"
MISSED = 3

_DESCRIPTION = f"""\
Measures shipped weights (`cfr models` lists them) again, on pairs of held-out shapes that also
ship, and says whether the score on their card holds here. Takes a minute or two.

Exits with {MISSED} if a score is worse than published by more than its tolerance, which leaves room
for the rounding of other processors.
"""


def add_parser(commands: Commands) -> None:
    """Adds `cfr reproduce`."""
    parser = commands.add_parser(
        "reproduce",
        help="measure the weights again, against their published score",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.set_defaults(run=run)
    parser.add_argument("name", metavar="NAME", help="weights by name, as `cfr models` lists them")
    parser.add_argument("--json", metavar="FILE", type=Path, help="the scores, as JSON (-: stdout)")


def run(args: argparse.Namespace) -> int:
    """Measures the weights, and compares the scores with those on their card."""
    to_stdout = args.json == Path("-")
    told = sys.stderr if to_stdout else sys.stdout
    if args.json is not None and not to_stdout:
        outputs.check_output("--json", args.json)

    from cfr_jax.weights import cards

    card = cards.read_card(args.name)

    from cfr_jax import __version__
    from cfr_jax.cli.shared.cache import keep_compiled_programs
    from cfr_jax.evaluation import reproduction
    from cfr_jax.runtime.atomic import write_atomically
    from cfr_jax.runtime.progress import Progress
    from cfr_jax.weights.files import load_params

    keep_compiled_programs()
    published: dict[str, Any] = card["reproduce"]
    print(f"{args.name} on {published['on']}", file=told)
    with Progress(total=reproduction.PAIRS, desc="registering", unit=" pairs") as bar:
        scores = reproduction.measure(load_params(args.name), bar.update)
    missed = reproduction.missed(scores, published["expected"], published["tolerance"])
    for stage, measured in scores.items():
        expected = models.scores_in_words(published["expected"][stage])
        print(f"{stage}, measured   {models.scores_in_words(measured)}", file=told)
        print(f"{stage}, published  {expected}", file=told)
    if args.json is not None:
        document = {
            "format": FORMAT,
            "version": __version__,
            "name": args.name,
            "sha256": card["sha256"],
            "on": published["on"],
            "measured": scores,
            "expected": published["expected"],
            "tolerance": published["tolerance"],
            "holds": not missed,
            "missed": missed,
        }
        text = json.dumps(document, indent=2) + "\n"
        if to_stdout:
            sys.stdout.write(text)
        else:
            write_atomically(args.json, text.encode())
            print(f"wrote       {args.json}")
    for text in missed:
        print(f"missed      {text}", file=told)
    print(f"the published score {'does not hold' if missed else 'holds'}", file=told)
    return MISSED if missed else 0
