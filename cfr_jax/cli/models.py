"""`cfr models`: lists the shipped weights, what they were trained on, and how good they are."""

from __future__ import annotations

import argparse
import json

from cfr_jax.cli.shared.commands import Commands

_DESCRIPTION = """\
Lists the weights that ship with the package: digest, parameters, the licenses of the data they were
trained on, and their measured scores. `cfr reproduce NAME` measures one of them again.
"""


def add_parser(commands: Commands) -> None:
    """Adds `cfr models`."""
    parser = commands.add_parser(
        "models",
        help="list the shipped weights and their scores",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.set_defaults(run=run)
    parser.add_argument("name", metavar="NAME", nargs="?", help="show only these weights")
    parser.add_argument("--json", action="store_true", help="everything on the cards, as JSON")


def run(args: argparse.Namespace) -> int:
    """Prints the cards."""
    from cfr_jax.weights import cards

    names = cards.names() if args.name is None else (args.name,)
    found = [cards.read_card(name) for name in names]
    if args.json:
        print(json.dumps({"format": "cfr_jax/models/1", "models": found}, indent=2))
        return 0
    for card in found:
        print(f"{card['name']}: {card['about']}")
        print(f"  sha256      {card['sha256']}")
        print(f"  parameters  {card['parameters']:,} ({card['bytes'] / 1e6:.1f} MB)")
        print(f"  trained on  {card['data']['what']}")
        for source in card["data"]["sources"]:
            print(f"              {source['name']}: {source['license']}")
        for row in card["measured"]:
            print(f"  measured    {row['what']}, {row['on']}:")
            print(f"              {scores_in_words(row['scores'])}")
        for stage, scores in card["reproduce"]["expected"].items():
            print(f"  reproduce   {stage}: {scores_in_words(scores)}")
    return 0


def scores_in_words(scores: dict[str, float]) -> str:
    """The scores in words: mean and median rotation error, and the shares of solved pairs."""
    recalls = []
    for name, share in scores.items():
        if name.startswith("recall_"):
            angle, distance = name.removeprefix("recall_").split("deg_")
            distance = distance.replace("m", " m")
            recalls.append(f"{share:.0%} within {angle}° and {distance}")
    errors = f"{scores['err_r_mean']:.2f}° mean, {scores['err_r_median']:.2f}° median"
    return f"rotation {errors}; {', '.join(recalls)}"
