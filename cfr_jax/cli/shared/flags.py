"""Flags that several commands have, each stated once, and what commands make of them.

A command picks its flags by name with `add`. `solving` and `weights_of` turn their values into what
`align` and `align_many` take.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any, Literal, TypedDict

from cfr_jax.cli.shared import numbers

if TYPE_CHECKING:
    from cfr_jax.weights.files import Weights

UNSURE = 3
"""The exit code of `--strict`: all is written, but not all of it can be trusted."""

_FLAGS: dict[str, dict[str, Any]] = {
    "--no-refine": {
        "action": "store_true",
        "help": "take the network's own answer, without the local refinement after it",
    },
    "--no-second-look": {
        "action": "store_true",
        "help": "keep the first answer; without this, one in doubt is tried again from other "
        "starts",
    },
    "--weights": {
        "metavar": "W",
        "help": "weights of the network: a name that ships with the package, or a .safetensors "
        "file",
    },
    "--max-points": {
        "metavar": "N",
        "type": numbers.positive,
        "help": "most points of each cloud that the network sees; more are slower (default: 1024)",
    },
    "--thinned": {
        "action": "store_true",
        "help": "stop at the points that the network sees; otherwise, larger clouds are refined on "
        "all of their points at the end",
    },
    "--scale": {
        "metavar": "auto|FACTOR",
        "type": numbers.scale,
        "default": 1.0,
        "help": "multiply the source by this first, such as 0.001 for millimeters onto meters; "
        "auto: estimate the factor, which takes about four times as long (default: 1)",
    },
    "--seed": {
        "metavar": "S",
        "type": numbers.not_negative,
        "default": 0,
        "help": "seed of the choice of points (default: 0); the same seed gives the same answer",
    },
    "--workers": {
        "metavar": "N",
        "type": numbers.positive,
        "help": "threads that read and prepare ahead (default: one for each core, at most 4)",
    },
    "--shard": {
        "metavar": "I/N",
        "help": "only every N-th pair, from the I-th on; auto: ask the cluster, by jax.distributed",
    },
    "--retry-failed": {"action": "store_true", "help": "retry the pairs that failed before"},
}


def add(parser: argparse._ActionsContainer, *names: str) -> None:
    """Adds shared flags to a parser, or to a group of it, in this order."""
    for name in names:
        parser.add_argument(name, **_FLAGS[name])


def add_strict(parser: argparse._ActionsContainer, when: str) -> None:
    """Adds `--strict`: `when` says what makes the command exit with `UNSURE`."""
    parser.add_argument("--strict", action="store_true", help=f"exit with {UNSURE} if {when}")


class Solving(TypedDict):
    """How pairs are registered: arguments of `align` and of `align_many`."""

    refine: bool | str
    second_look: bool
    max_points: int | None
    all_points: bool
    scale: float | Literal["auto"]
    seed: int


def solving(args: argparse.Namespace, refine: bool | str = True) -> Solving:
    """What the flags of a command that registers pairs ask for; `refine`: without --no-refine."""
    return {
        "refine": False if args.no_refine else refine,
        "second_look": not args.no_second_look,
        "max_points": args.max_points,
        "all_points": not args.thinned,
        "scale": args.scale,
        "seed": args.seed,
    }


def weights_of(wish: str | None) -> Weights:
    """The weights that `--weights` names, or the usual ones for None.

    Raises ValueError like `read_weights`, and for weights of another network than ours.
    """
    from cfr_jax.weights.files import DEFAULT, read_weights

    return read_weights(DEFAULT if wish is None else wish, "cfr")
