"""What the commands that read clouds share: their formats, `--columns`, and warnings in words."""

from __future__ import annotations

import argparse
import sys
import textwrap
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cfr_jax.io import formats

if TYPE_CHECKING:
    from cfr_jax.io import PointCloud

_AS_THE_FILE_SAYS = "-"


def files_in_words() -> str:
    """The formats that are read, a line of each sort, wrapped for a help text."""
    bare = [form for form in formats.entries() if form.holds == "surface"]
    either = [form for form in formats.entries() if form.holds == "either"]
    surfaces = f"{formats.in_words(bare)}, and {formats.in_words(either)} with faces: points are"
    lines = {
        "clouds": formats.in_words(formats.of_clouds()),
        "surfaces": f"{surfaces} drawn from them by area",
    }
    return "\n".join(
        textwrap.fill(
            text,
            width=100,
            initial_indent=f"  {sort:10s}",
            subsequent_indent=" " * 12,
            break_on_hyphens=False,
        )
        for sort, text in lines.items()
    )


def add_columns(parser: Any) -> None:
    """Adds `--columns` to a parser or to a group of it."""
    parser.add_argument(
        "--columns",
        metavar="NAMES",
        action="append",
        help="names of the columns in order, for files that do not say them, as x,y,z,intensity; "
        "given twice, for the source and for the target; - is as the file says",
    )


def columns_of(args: argparse.Namespace) -> tuple[tuple[str, ...] | None, ...]:
    """The names for the source and for the target; raises ValueError for names without x, y, z."""
    from cfr_jax.io.naming import checked_columns

    given = args.columns or [_AS_THE_FILE_SAYS]
    if len(given) > 2:
        raise ValueError(f"--columns: given {len(given)} times, wanted once or twice")
    try:
        named = [None if text == _AS_THE_FILE_SAYS else checked_columns(text) for text in given]
    except ValueError as error:
        raise ValueError(f"--{error}") from None
    return named[0], named[-1]


def with_columns(pairs: Iterable[Any], args: argparse.Namespace) -> Iterator[Any]:
    """Pairs of files, to be read with the columns that `args` names when their turn comes.

    Raises ValueError for a pair whose clouds do not lie in files of their own.
    """
    source_columns, target_columns = columns_of(args)
    if source_columns is None and target_columns is None:
        yield from pairs
        return
    for pair in pairs:
        if callable(pair):
            raise ValueError("--columns: these data say themselves what they hold")
        source, target = pair
        yield partial(_pair, source, source_columns, target, target_columns)


def _pair(
    source: Path,
    source_columns: tuple[str, ...] | None,
    target: Path,
    target_columns: tuple[str, ...] | None,
) -> tuple[PointCloud, PointCloud]:
    return _read(source, source_columns), _read_again(target, target_columns)


def _read(path: Path, columns: tuple[str, ...] | None) -> PointCloud:
    from cfr_jax import io

    return io.read(path, columns=columns)


# A target of many sources stays one object, so that it is prepared once.
_read_again = lru_cache(maxsize=4)(_read)


@contextmanager
def telling(command: str) -> Iterator[None]:
    """Prints what was read or written by a rule, as warnings of the command; each note once."""
    from cfr_jax.io import CloudWarning

    told: set[str] = set()
    with warnings.catch_warnings():
        warnings.simplefilter("always", CloudWarning)
        usual = warnings.showwarning

        def show(message: Warning | str, *place: Any, **more: Any) -> None:
            if not isinstance(message, CloudWarning):
                usual(message, *place, **more)
            elif message.note not in told:
                told.add(message.note)
                print(f"{command}: warning: {message}", file=sys.stderr)

        warnings.showwarning = show
        yield
