"""The rows of a text, block by block, so that memory stays near what the points take."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float64

from cfr_jax.io.budget import POINT, check_room
from cfr_jax.io.cloud import CloudFileError
from cfr_jax.io.formats.text.dialect import Layout
from cfr_jax.io.formats.text.lines import bad_line, block_end, without_comments

_CANNOT = re.compile(r"could not convert string .* at row \d+, column (\d+)")
_MARKS = ".eEnN"  # one of them is in every number that is not an integer: 1.5, 1e3, nan, inf
_IS_MARK = np.isin(np.arange(256), [ord(mark) for mark in _MARKS])
_ENDS = (np.iinfo(np.int64).min, np.iinfo(np.int64).max)  # what too large an integer becomes


def read_numbers(
    data: bytes, layout: Layout, columns: tuple[int, ...] | None
) -> Float64[np.ndarray, "n c"]:
    """The chosen columns of all rows as float64; all columns if None, which no row may lack."""
    width = layout.width if columns is None else len(columns)
    # Points that are no whole row are copied, and normals are scaled as well.
    each = 8 * width + {3: 0, 6: 3 * POINT}.get(width, POINT)
    most = data.count(b"\n", layout.body) + 1
    table = np.empty((most, width))
    done = 0
    for line, block in blocks(data, layout):
        rows = _load(block, line, layout, columns, np.dtype(np.float64))
        if len(rows) and rows.shape[1] != width:
            raise _uneven(line)
        check_room(done + len(rows), each, len(data), "rows of numbers and more")
        table[done : done + len(rows)] = rows
        done += len(rows)
    return table[:done]


def read_columns(data: bytes, layout: Layout, numbers: Sequence[int]) -> list[np.ndarray]:
    """All columns, each in the narrowest type of int64, float64 and text that holds it.

    Raises CloudFileError where a column of `numbers` holds something else.
    """
    kinds = ["i8"] * layout.width
    parts: list[list[np.ndarray]] = [[] for _ in kinds]
    taken = 0
    for line, block in blocks(data, layout):
        for column, part in enumerate(_typed(block, line, layout, kinds, numbers)):
            parts[column].append(part)
            taken += part.nbytes + 8 * len(part) * (column < 3)  # and as points
        check_room(taken, 1, len(data), "bytes of columns and more")
    columns = []
    for pieces in parts:
        columns.append(np.concatenate(pieces) if pieces else np.empty(0))
        pieces.clear()
    return columns


def _typed(
    block: bytes, line: int, layout: Layout, kinds: list[str], numbers: Sequence[int]
) -> list[np.ndarray]:
    """The columns of a block; `kinds` are widened where they do not hold what comes."""
    if "i8" in kinds:
        # not left to numpy's parser: before 2.4 it reads 3.7 as the integer 3
        for column in _not_integers(block, line, layout):
            if kinds[column] == "i8":
                kinds[column] = "f8"
    while True:
        chosen = tuple(k for k, kind in enumerate(kinds) if kind != "U")
        found: dict[int, np.ndarray] = {}
        if chosen:
            dtype = np.dtype([(f"f{k}", kinds[k]) for k in chosen])
            try:
                rows = _load(block, line, layout, chosen, dtype)
            except _Unfit as unfit:
                if kinds[unfit.column] == "f8" and unfit.column in numbers:
                    where = line + bad_line(block, layout.delimiter, (unfit.column,))
                    raise CloudFileError(f"line {where}: {unfit}") from None
                kinds[unfit.column] = "f8" if kinds[unfit.column] == "i8" else "U"
                continue
            found = {k: rows[f"f{k}"] for k in chosen}
            too_large = [k for k in chosen if kinds[k] == "i8" and np.isin(found[k], _ENDS).any()]
            if too_large:
                kinds[too_large[0]] = "f8"
                continue
        words = [k for k, kind in enumerate(kinds) if kind == "U"]
        if words:
            cells = _cells(block, line, layout)
            found |= {k: np.array([row[k].strip() for row in cells]) for k in words}
        if len({len(values) for values in found.values()}) > 1:
            raise _uneven(line)
        return [found[k] for k in range(len(kinds))]


def _not_integers(block: bytes, line: int, layout: Layout) -> list[int]:
    """The columns in which a cell has a mark of a number that is not an integer."""
    raw = np.frombuffer(block, np.uint8)
    marks = np.flatnonzero(_IS_MARK[raw])
    if not len(marks):
        return []
    if layout.quoted:  # a cell may hold delimiters
        rows = _cells(block, line, layout)
        return [k for k in range(layout.width) if any({*_MARKS} & {*row[k]} for row in rows)]
    if layout.delimiter is None:
        filled = raw > 32
        begins = filled.copy()
        begins[1:] &= ~filled[:-1]
        cells = np.cumsum(begins) - 1
    else:
        cells = np.cumsum(raw == ord(layout.delimiter))
    # the cell before a row's first; `cells` has counted those of all rows before
    ends = np.concatenate([[-1], np.flatnonzero(raw == 10)])
    before = ends[np.searchsorted(ends, marks) - 1]
    first = np.where(before < 0, 0, cells[before] + (layout.delimiter is None))
    columns = np.unique(cells[marks] - first)
    return columns[columns < layout.width].tolist()


def _cells(block: bytes, line: int, layout: Layout) -> list[list[str]]:
    """The cells of a block's rows, as words."""
    reader = csv.reader(
        block.decode("utf-8", "replace").split("\n"),
        delimiter=layout.delimiter or " ",
        skipinitialspace=True,
    )
    try:
        rows = [row for row in reader if row and (len(row) > 1 or row[0].strip())]
    except csv.Error as error:
        raise CloudFileError(f"behind line {line}: {error}") from None
    if min(map(len, rows), default=layout.width) < layout.width:
        raise _uneven(line)
    return rows


class _Unfit(ValueError):
    """A cell that its column's type does not hold."""

    def __init__(self, column: int, told: str) -> None:
        super().__init__(told)
        self.column = column


def blocks(data: bytes, layout: Layout) -> Iterator[tuple[int, bytes]]:
    """Whole lines of the body, half a megabyte at a time, cleaned of comments and carriage returns.

    With each comes the number of its first line. A file that says how many points it has ends
    there.
    """
    start, line = layout.body, layout.line
    left = layout.count
    while start < len(data) and left != 0:
        end = block_end(data, start, len(data), line)
        block = data[start:end]
        newlines = block.count(b"\n")
        if b"\r" in block:
            block = block.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        if b"#" in block or b"//" in block:
            block = without_comments(block, (b"#", b"//")).tobytes()
        if layout.commas_are_blanks:
            block = block.replace(b",", b" ")
        elif layout.decimal_comma:
            block = block.replace(b",", b".")
        if block.strip():
            yield line, block
        start, line = end, line + newlines


def _load(
    block: bytes, line: int, layout: Layout, columns: tuple[int, ...] | None, dtype: np.dtype
) -> np.ndarray:
    """Rows of a block by numpy's parser; a mistake is told by its line."""
    if columns is None and layout.trailing:
        columns = tuple(range(layout.width))
    if columns is not None and not layout.quoted:
        _check_widths(block, line, layout)
    try:
        return np.loadtxt(
            io.BytesIO(block),
            dtype,
            comments=None,
            delimiter=layout.delimiter,
            usecols=columns,
            ndmin=1 if dtype.names else 2,
            encoding="utf-8" if layout.quoted else "latin1",
            quotechar='"' if layout.quoted else None,
        )
    except ValueError as error:
        told = _CANNOT.search(str(error))
        if dtype.names and told is not None:
            raise _Unfit(int(told[1]) - 1, str(error)) from None
        where = line + bad_line(block, layout.delimiter, columns)
        raise CloudFileError(f"line {where}: {error}") from None


def _check_widths(block: bytes, line: int, layout: Layout) -> None:
    """Raises CloudFileError for the first line with more or fewer cells than the first row."""
    raw = np.frombuffer(block, np.uint8)
    ends = np.flatnonzero(raw == 10)
    starts = np.concatenate([[0], ends + 1])
    starts = starts[starts < len(raw)]
    if layout.delimiter is None:
        filled = raw > 32
        filled[1:] &= ~(raw[:-1] > 32)
        cells = np.add.reduceat(filled, starts, dtype=np.int32)
        wrong = (cells != layout.width) & (cells > 0)
    else:
        marks = raw == ord(layout.delimiter)
        cells = np.add.reduceat(marks, starts, dtype=np.int32) + 1
        blank = np.maximum.reduceat(raw, starts) <= 32
        wrong = (cells != layout.width + layout.trailing) & (cells != layout.width) & ~blank
    if wrong.any():
        row = int(np.argmax(wrong))
        raise CloudFileError(
            f"line {line + row}: the number of columns changed from {layout.width} to {cells[row]}"
        )


def _uneven(line: int) -> CloudFileError:
    return CloudFileError(f"behind line {line}: the number of columns changed")
