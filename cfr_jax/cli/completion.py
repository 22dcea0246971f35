"""`cfr completion SHELL`: the script that lets a shell complete this command."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

from cfr_jax.cli.shared.commands import Commands

SHELLS = ("bash", "zsh", "fish")

_DESCRIPTION = """\
Writes the script that lets a shell complete commands, options and file names. It is made from
the options of `cfr` (pip install "cfr_jax[completion]"):

  bash   cfr completion bash > ~/.local/share/bash-completion/completions/cfr
  zsh    cfr completion zsh > "${fpath[1]}/_cfr"
  fish   cfr completion fish > ~/.config/fish/completions/cfr.fish
"""


def add_parser(commands: Commands) -> None:
    """Adds `cfr completion`."""
    parser = commands.add_parser(
        "completion",
        help="let bash, zsh or fish complete this command",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.set_defaults(run=run)
    parser.add_argument("shell", metavar="SHELL", choices=SHELLS, help=", ".join(SHELLS))


def run(args: argparse.Namespace) -> int:
    """Prints the script."""
    try:
        import shtab
    except ModuleNotFoundError:
        raise ValueError('completion needs shtab: pip install "cfr_jax[completion]"') from None

    from cfr_jax.cli import make_parser

    parser = make_parser()
    _complete_files(parser, shtab.FILE)
    print(shtab.complete(parser, args.shell))
    return 0


def _complete_files(parser: argparse.ArgumentParser, file: Any) -> None:
    """Lets arguments that are paths complete to file names, in every command."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                _complete_files(command, file)
        elif _is_path(action.type):
            action.complete = file  # type: ignore[attr-defined]


def _is_path(kind: Callable | str | None) -> bool:
    return getattr(kind, "__name__", "") == "Path"
