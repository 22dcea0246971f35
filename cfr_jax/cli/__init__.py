"""The command `cfr`: one file per command, each with `add_parser` and `run`.

Only a command that computes imports JAX or numpy, and only once it runs: help stays instant.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from cfr_jax import __version__
from cfr_jax.cli import (
    batch,
    calibrate,
    completion,
    convert,
    data,
    demo,
    export,
    merge,
    models,
    register,
    reproduce,
    view,
)
from cfr_jax.runtime.messages import tidy

_COMMANDS = (
    register,
    batch,
    merge,
    view,
    demo,
    models,
    reproduce,
    export,
    convert,
    calibrate,
    data,
    completion,
)

_DESCRIPTION = """\
Registers 3D point clouds: finds the rigid motion that lays one cloud on another.

  cfr demo                          see it work on a pair that ships with it
  cfr register scan1.ply scan2.pcd  the motion from scan1 onto scan2, and how far to trust it
"""

_EPILOG = """\
exit codes:
  0    done
  1    a bug, with a traceback: in the program (please report it), or in a function of yours
  2    an input, an option or an output that cannot be used (at most three lines on stderr)
  3    registered, but not to be trusted (only with --strict)
  130  interrupted
  141  the reader of the output closed it

environment:
  CFR_JAX_CACHE      where compiled programs are kept, so that the next call starts faster:
                     a folder, or "off" (default: $XDG_CACHE_HOME/cfr_jax or ~/.cache/cfr_jax)
  CFR_JAX_TRACEBACK  set it to get the traceback of an error message
"""

INTERRUPTED = 130
READER_GONE = 141
UNUSABLE = 2


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns its exit code (`cfr --help` lists them)."""
    # XLA would comment on slow compilations; standard error is for what the user can act on.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    try:
        if sys.stdout is not None and hasattr(sys.stdout, "reconfigure"):
            # The name of a file may hold bytes that no encoding can print.
            sys.stdout.reconfigure(errors="backslashreplace")
        return _run(argv)
    except BrokenPipeError:
        _drop_output()
        return READER_GONE
    except KeyboardInterrupt:
        return INTERRUPTED


def _run(argv: Sequence[str] | None) -> int:
    where = "cfr"
    try:
        try:
            args = make_parser().parse_args(argv)
            where = f"cfr {args.command}"
            code = args.run(args)
        except SystemExit as stop:  # after help, or after `_Parser.error`
            code = int(stop.code or 0)
        if sys.stdout is not None:
            sys.stdout.flush()  # while a full disk can still be reported
        return code
    except BrokenPipeError:
        raise
    except (ValueError, OSError) as error:
        if os.environ.get("CFR_JAX_TRACEBACK"):
            raise
        _drop_output()
        print(_complaint(where, str(error)), file=sys.stderr)
        return UNUSABLE


def _drop_output() -> None:
    """Drops what is still buffered, if standard output takes no more.

    Otherwise the interpreter would flush again on exit, and complain.
    """
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class _Parser(argparse.ArgumentParser):
    """Reports errors in a few lines: the usage of a command would bury what was wrong."""

    def parse_known_args(self, *given: Any, **named: Any) -> Any:
        """Rejects unknown options here, where the command is known: the parser of all commands
        would name neither the command nor its help."""
        found, unknown = super().parse_known_args(*given, **named)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return found, unknown

    def error(self, message: str) -> NoReturn:
        self.exit(UNUSABLE, _complaint(self.prog, message, f"try {self.prog} --help") + "\n")


def _complaint(where: str, message: str, *hints: str) -> str:
    return tidy("\n".join([f"{where}: error: {message}", *hints]))


def make_parser() -> argparse.ArgumentParser:
    """All commands with all their options."""
    parser = _Parser(
        prog="cfr",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"cfr_jax {__version__}")
    commands = parser.add_subparsers(
        title="commands", dest="command", metavar="COMMAND", required=True
    )
    for command in _COMMANDS:
        command.add_parser(commands)
    return parser
