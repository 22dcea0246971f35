"""How a text file separates its numbers, what its first lines say, and where its points begin.

All of this is told from the first lines; the body is then read by numpy's parser.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass

from cfr_jax.io.cloud import CloudFileError
from cfr_jax.io.naming import HOW_TO_SAY, are_names, roles_of

_HEAD = 1 << 16  # bytes in which the first row of numbers has to begin
_COMMENT_MARKS = ("#", "//", "%", "!")
_SEPARATOR_LINE = re.compile(r"sep\s*=\s*(.)", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?")
_WORD_BREAK = re.compile(r"[\s,;]+")
_PROSE = ("columns", "column", "fields", "field", "format", "names", "header", "data")


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
        if are_names(_split(line, _delimiter_of(line, separator)[0])):
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
    words = [word.strip("\"'") for word in _WORD_BREAK.split(_uncommented(line)) if word]
    numbers = sum(map(_is_number, words))
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


def _is_number(word: str) -> bool:
    try:
        float(word.replace("_", "?"))  # Python allows 1_000, numpy does not
    except ValueError:
        return False
    return True


def _delimiter_of(line: str, separator: str | None) -> tuple[str | None, bool, bool]:
    """The delimiter of a row, whether commas are decimal, and whether they are mere blanks."""
    if separator is not None and separator in line:
        return (None if separator == " " else separator), separator != "," and "," in line, False
    if ";" in line:
        return ";", "," in line and "." not in line, False
    words = line.split()
    if "," in line:
        if len(words) >= 3 and all(
            _DECIMAL_COMMA.fullmatch(word) or _is_number(word) for word in words
        ):
            return ("\t" if "\t" in line and " " not in line else None), True, False
        cells = [cell.strip() for cell in line.split(",")]
        inner = any(len(cell.split()) > 1 for cell in cells)
        if inner and all(_is_number(word) for word in _WORD_BREAK.split(line) if word):
            return None, False, True
        return ",", False, False
    if "\t" in line and not any(len(cell.split()) > 1 for cell in line.split("\t")):
        return "\t", False, False
    return None, False, False


def _split(line: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        if '"' not in line:
            return line.split()
        return next(csv.reader([" ".join(line.split())], delimiter=" "), [])
    cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    return [cell.strip() for cell in cells]


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
    delimiter, decimal_comma, commas_are_blanks = _delimiter_of(row, separator)
    plain = row.replace(",", " ") if commas_are_blanks else row
    cells = _split(plain, delimiter)
    trailing = len(cells) > 1 and cells[-1] == ""
    width = len(cells) - trailing
    notes: tuple[str, ...] = ()
    if decimal_comma and delimiter != ";" and separator is None:
        notes += ("took commas for decimal ones, since blanks separate the numbers",)
    names: tuple[str, ...] | None = None
    skipped = 0
    if columns is None:
        names, skipped, more = _names(comments, heads, delimiter, width)
        notes += more
    return Layout(
        names, delimiter, decimal_comma, commas_are_blanks, '"' in row, width, trailing, offset,
        number, count, skipped, notes,
    )  # fmt: skip


def _names(
    comments: list[str], heads: list[tuple[int, str]], delimiter: str | None, width: int
) -> tuple[tuple[str, ...] | None, int, tuple[str, ...]]:
    """Names for the columns, how many to skip in front of them, and notes."""
    for number, line in heads:
        cells = _best_split(line, delimiter, width)
        if all(cell == "" or cell.isdecimal() for cell in cells):  # columns numbered by pandas
            skipped = int(cells[0] == "")
            return None, skipped, ("left out the index in front of the rows",) * skipped
        if len(cells) == width + 1 and cells[-1] == "":
            cells = cells[:-1]
        if len(cells) == width - 1 and are_names(cells):
            note = "there is one name less than columns: took the first column for an index"
            return ("", *cells), 0, (note,)
        try:
            roles_of(cells)
        except ValueError as error:
            raise CloudFileError(f"line {number}: {error}") from None
        if len(cells) != width:
            raise CloudFileError(
                f"line {number}: names {len(cells)} columns, the rows have {width}; {HOW_TO_SAY}"
            )
        return tuple(cells), 0, ()
    for line in reversed(comments):
        cells = _best_split(line, delimiter, width)
        while len(cells) > width and cells[0].rstrip(":=").lower() in _PROSE:
            cells = cells[1:]
        if len(cells) == width and are_names(cells):
            return tuple(cells), 0, ()
        words = [word for word in _WORD_BREAK.split(line) if word]
        bare = [word.strip(".:()[]\"'").lower() for word in words]
        if not {"x", "y", "z"} <= set(bare):
            continue
        order = [bare.index(axis) for axis in "xyz"]
        first = order[0] == 0 and order == sorted(order) and order[2] == 2
        if (width == 3 and order == sorted(order)) or (first and len(cells) < width):
            return None, 0, ()  # says what the columns are taken for anyway
        raise CloudFileError(
            f"a comment ({line!r:.60}) names {len(cells)} columns, the rows have {width}; "
            f"{HOW_TO_SAY}"
        )
    return None, 0, ()


def _best_split(line: str, delimiter: str | None, width: int) -> list[str]:
    """Names may be separated otherwise than the numbers below them."""
    tried = [_split(line, way) for way in (delimiter, ",", ";", "\t", None)]
    if "(" in line or "[" in line:  # "x [m] y [m] z [m]" by blanks
        tried.append(re.findall(r"[^\s\[(]+(?:\s*[\[(][^\])]*[\])])?", line))
    fitting = [cells for cells in tried if len(cells) == width]
    return next((cells for cells in fitting if are_names(cells)), (fitting or tried)[0])
