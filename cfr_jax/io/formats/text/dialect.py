"""How a text file separates its numbers, what its first lines say, and where its points begin.

All of this is told from the first lines; the body is then read by numpy's parser.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterator
from dataclasses import dataclass

from cfr_jax.io.cloud import CloudFileError
from cfr_jax.io.formats.text.cells import WORD_BREAK, delimiter_of, is_number, names_of, split
from cfr_jax.io.naming import are_names

_HEAD = 1 << 16  # bytes in which the first row of numbers has to begin
_COMMENT_MARKS = ("#", "//", "%", "!")
_SEPARATOR_LINE = re.compile(r"sep\s*=\s*(.)", re.IGNORECASE)


@dataclass(frozen=True)
class Layout:
    """What the first lines of a text tell about the rest."""

    names: tuple[str, ...] | None
    """Of the columns, as they stand in the file; None if it has none."""
    delimiter: str | None
    """None: any blanks."""
    decimal_comma: bool
    commas_are_blanks: bool
    quoted: bool
    width: int
    """Cells of the first row, without an empty one at its end."""
    trailing: bool
    """Whether rows end with a delimiter."""
    body: int
    """Byte at which the first row of points begins."""
    line: int
    """The number of that row's line, from 1."""
    count: int | None
    """How many points the file says to have, if it does."""
    skipped: int
    """Leading columns that only number the rows."""
    notes: tuple[str, ...]


def decoded(data: bytes) -> bytes:
    """The text in UTF-8 or another superset of ASCII, without a byte order mark.

    UTF-16 is told by its mark or by its zero bytes. Raises CloudFileError for other binary data.
    """
    if data.startswith(codecs.BOM_UTF8):
        data = data[3:]
    elif data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return _from_utf16(data, "utf-16")
    elif len(data) >= 4 and data[1] == data[3] == 0 and data[0] and data[2]:
        return _from_utf16(data, "utf-16-le")
    elif len(data) >= 4 and data[0] == data[2] == 0 and data[1] and data[3]:
        return _from_utf16(data, "utf-16-be")
    if b"\0" in data:
        raise CloudFileError(f"byte {data.index(0)}: is zero, wanted text")
    if b"\r" in data[:_HEAD] and b"\n" not in data:
        data = data.replace(b"\r", b"\n")
    return data


def _from_utf16(data: bytes, encoding: str) -> bytes:
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as error:
        raise CloudFileError(f"byte {error.start}: wanted text in UTF-16: {error.reason}") from None
    if "\0" in text:
        raise CloudFileError(f"character {text.index(chr(0))}: is zero, wanted text")
    return text.encode("utf-8", "replace").removeprefix(codecs.BOM_UTF8)


def layout_of(data: bytes, columns: tuple[str, ...] | None) -> Layout:
    """The layout of a decoded text; `columns` are names that the user gave.

    Raises CloudFileError where there is no row of numbers, and where names and rows do not fit.
    """
    separator: str | None = None
    count: int | None = None
    comments: list[str] = []
    heads: list[tuple[int, str]] = []
    for number, offset, line in _lines(data):
        said = _SEPARATOR_LINE.fullmatch(line)
        if said is not None and not heads and separator is None:
            separator = said[1]
        elif line.startswith(_COMMENT_MARKS):
            comments.append(line.lstrip("#/%! \t"))
        elif line.isdecimal() and count is None and not heads and not _is_last(data, offset, line):
            count = int(line[:18])
        elif _is_row(line) and not _are_numbered(line, heads, data, offset):
            return _finished(line, number, offset, separator, count, comments, heads, columns)
        else:
            heads.append((number, line))
    if heads:
        number, line = heads[0]
        if are_names(split(line, delimiter_of(line, separator)[0])):
            raise CloudFileError("holds no points below its line of names, wanted one at least")
        raise CloudFileError(f"line {number}: wanted numbers or names of columns, got {line!r:.80}")
    raise CloudFileError("holds no points, wanted a line of x, y, z at least")


def _lines(data: bytes) -> Iterator[tuple[int, int, str]]:
    """The filled lines at the beginning: number, offset and stripped text."""
    offset = 0
    number = 0
    while offset < min(len(data), _HEAD):
        end = data.find(b"\n", offset)
        end = len(data) if end < 0 else end
        number += 1
        line = data[offset : min(end, offset + _HEAD)].decode("utf-8", "replace").strip()
        if line:
            yield number, offset, line.partition("\r")[0].strip()  # the body cuts there, too
        offset = end + 1


def _is_last(data: bytes, offset: int, line: str) -> bool:
    """Whether nothing follows the line: then it is a row and no count."""
    return not data[offset:].strip()[len(line) :].strip()


def _is_row(line: str) -> bool:
    """Whether a line has three numbers at least, or nothing but numbers."""
    words = [word.strip("\"'") for word in WORD_BREAK.split(_uncommented(line)) if word]
    numbers = sum(map(is_number, words))
    return numbers >= 3 or (numbers > 0 and numbers == len(words))


def _uncommented(line: str) -> str:
    return line.partition("#")[0].partition("//")[0].strip()


def _are_numbered(line: str, heads: list[tuple[int, str]], data: bytes, offset: int) -> bool:
    """Whether a first line 0, 1, 2, … numbers the columns, as pandas does for those without names.

    It does if rows of fractions follow, or if the cell before the 0 is empty.
    """
    cells = [cell.strip().strip("\"'") for cell in re.split(r"[,;\t]", line)]
    if heads or len(cells) < 3:
        return False
    if cells[0] == "":
        return cells[1:] == [str(k) for k in range(len(cells) - 1)]
    if cells != [str(k) for k in range(len(cells))]:
        return False
    following = data[offset:].split(b"\n", 2)[1:2]
    return bool(following) and b"." in following[0]


def _finished(
    row: str,
    number: int,
    offset: int,
    separator: str | None,
    count: int | None,
    comments: list[str],
    heads: list[tuple[int, str]],
    columns: tuple[str, ...] | None,
) -> Layout:
    """The layout, once the first row of numbers is found."""
    row = _uncommented(row)
    delimiter, decimal_comma, commas_are_blanks = delimiter_of(row, separator)
    plain = row.replace(",", " ") if commas_are_blanks else row
    cells = split(plain, delimiter)
    trailing = len(cells) > 1 and cells[-1] == ""
    width = len(cells) - trailing
    notes: tuple[str, ...] = ()
    if decimal_comma and delimiter != ";" and separator is None:
        notes += ("took commas for decimal ones, since blanks separate the numbers",)
    names: tuple[str, ...] | None = None
    skipped = 0
    if columns is None:
        names, skipped, more = names_of(comments, heads, delimiter, width)
        notes += more
    return Layout(
        names, delimiter, decimal_comma, commas_are_blanks, '"' in row, width, trailing, offset,
        number, count, skipped, notes,
    )  # fmt: skip
