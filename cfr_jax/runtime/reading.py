"""Opens the files that users name: regular files only, and no more of them than memory can hold.

Reading a pipe or a device may never end, and a file of the kernel (`/proc`, `/sys`) may hold more
than it says. All code that reads bytes that users hand over comes through here.
"""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from typing import Any

from cfr_jax.runtime.messages import Refused

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
)
_DIGITS = 20  # of the longest integer of 64 bits, with its sign


@contextmanager
def opened(path: str | os.PathLike[str], most: int | None = None) -> Iterator[BufferedReader]:
    """A regular, nonempty file for reading; raises `Refused`, without the path, for anything else.

    `most` is the largest size in bytes that is read, by default half of this machine's memory.
    """
    try:
        # without O_NONBLOCK, opening a pipe waits until somebody writes to it
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        stream = open(path, "rb", opener=lambda name, _: os.open(name, flags))
    except IsADirectoryError:
        raise Refused("is a folder, wanted a file") from None
    except OSError as error:
        # opening a socket or a device without a driver fails, too
        kind = _kind_of(path)
        raise Refused(
            f"is not a regular file but {kind}" if kind else f"cannot be read: {error.strerror}"
        ) from None
    except ValueError as error:  # a null byte in the name
        raise Refused(f"is no name of a file ({error})") from None
    with stream:
        found = os.fstat(stream.fileno())
        if not stat.S_ISREG(found.st_mode):
            raise Refused(f"is not a regular file but {_in_words(found.st_mode)}")
        if not found.st_size:  # files in /proc say so, too, and some of them never end
            raise Refused("is empty")
        most = _memory() // 2 if most is None else most
        if found.st_size > most:
            raise Refused(f"is too large: {found.st_size:,} bytes, wanted at most {most:,}")
        yield stream


def contents(path: str | os.PathLike[str], most: int | None = None) -> bytes:
    """All bytes of a file that a user names; raises `Refused` as `opened` does."""
    with opened(path, most) as stream:
        size = os.fstat(stream.fileno()).st_size
        try:
            data = stream.read(size)
        except OSError as error:  # a disk that cannot read its own sectors
            raise Refused(f"cannot be read: {error.strerror}") from None
        except MemoryError:
            raise Refused(f"is too large: {size:,} bytes do not fit into memory") from None
    if not data:  # a file of the kernel that says another size than it has
        raise Refused("is empty")
    return data


def text(path: str | os.PathLike[str], most: int | None = None) -> str:
    """A text file in UTF-8, with or without a byte order mark; raises `Refused` as `opened` does,
    and where the bytes are no text."""
    try:
        return contents(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise Refused(f"is no text in UTF-8 (byte {error.start})") from None


def parse_json(data: str | bytes) -> Any:
    """The value of a JSON text; raises `Refused` for everything that is none.

    NaN and Infinity, which JSON does not have, are refused. An integer beyond 64 bits becomes a
    float, as in most languages, and one beyond the floats becomes infinite.
    """
    try:
        return json.loads(data, parse_int=_integer, parse_constant=_no_number)
    except RecursionError:
        raise Refused("is nested too deeply for JSON of ours") from None
    except UnicodeDecodeError as error:
        raise Refused(f"is no text in UTF-8 (byte {error.start})") from None
    except ValueError as error:
        raise Refused(f"is no JSON: {error}") from None


def irregular(path: str | os.PathLike[str]) -> str | None:
    """In words what a path is that is neither a file nor a folder; None if it is one, or nothing
    is there."""
    kind = _kind_of(path)
    return None if kind == "a folder" else kind


def _kind_of(path: str | os.PathLike[str]) -> str | None:
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return None
    return None if stat.S_ISREG(mode) else _in_words(mode)


def _in_words(mode: int) -> str:
    return next((words for is_kind, words in _KINDS if is_kind(mode)), "something else")


def _memory() -> int:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):  # systems that do not tell
        return 1 << 34


def _integer(digits: str) -> int | float:
    # the longest ones are not converted: that takes time that grows with the square of the length
    if len(digits) <= _DIGITS and -(1 << 63) <= (value := int(digits)) < 1 << 63:
        return value
    return float(digits)


def _no_number(name: str) -> None:
    raise Refused(f"{name} stands where a number was wanted")
