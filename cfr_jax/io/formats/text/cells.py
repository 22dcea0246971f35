"""How a line of text is cut into cells, and which of its lines names the columns."""

from __future__ import annotations

import csv
import re

from cfr_jax.io.cloud import CloudFileError
from cfr_jax.io.naming import HOW_TO_SAY, are_names, roles_of

_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?")
WORD_BREAK = re.compile(r"[\s,;]+")
_PROSE = ("columns", "column", "fields", "field", "format", "names", "header", "data")


def is_number(word: str) -> bool:
    """Whether numpy's parser reads the word as a number."""
    try:
        float(word.replace("_", "?"))  # Python allows 1_000, numpy does not
    except ValueError:
        return False
    return True


def delimiter_of(line: str, separator: str | None) -> tuple[str | None, bool, bool]:
    """The delimiter of a row, whether commas are decimal, and whether they are mere blanks."""
    if separator is not None and separator in line:
        return (None if separator == " " else separator), separator != "," and "," in line, False
    if ";" in line:
        return ";", "," in line and "." not in line, False
    words = line.split()
    if "," in line:
        if len(words) >= 3 and all(
            _DECIMAL_COMMA.fullmatch(word) or is_number(word) for word in words
        ):
            return ("\t" if "\t" in line and " " not in line else None), True, False
        cells = [cell.strip() for cell in line.split(",")]
        inner = any(len(cell.split()) > 1 for cell in cells)
        if inner and all(is_number(word) for word in WORD_BREAK.split(line) if word):
            return None, False, True
        return ",", False, False
    if "\t" in line and not any(len(cell.split()) > 1 for cell in line.split("\t")):
        return "\t", False, False
    return None, False, False


def split(line: str, delimiter: str | None) -> list[str]:
    """The cells of a line without blanks around them; None: blanks separate them."""
    if delimiter is None:
        if '"' not in line:
            return line.split()
        return next(csv.reader([" ".join(line.split())], delimiter=" "), [])
    cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    return [cell.strip() for cell in cells]


def names_of(
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
        words = [word for word in WORD_BREAK.split(line) if word]
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
    tried = [split(line, way) for way in (delimiter, ",", ";", "\t", None)]
    if "(" in line or "[" in line:  # "x [m] y [m] z [m]" by blanks
        tried.append(re.findall(r"[^\s\[(]+(?:\s*[\[(][^\])]*[\])])?", line))
    fitting = [cells for cells in tried if len(cells) == width]
    return next((cells for cells in fitting if are_names(cells)), (fitting or tried)[0])
