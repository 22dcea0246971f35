"""Rows of numbers in text, read by numpy's parser block by block; a mistake is told by its line."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from cfr_jax.io.budget import check_room
from cfr_jax.io.cloud import CloudFileError

_BLANKS_TO_NEWLINES = bytes.maketrans(b" \t\v\f\r", b"\n\n\n\n\n")
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_BLOCK = 1 << 19
_LONGEST_LINE = 1 << 19


def clean_text(data: bytes) -> bytes:
    """Lines that end in a newline, each at the byte where it was; refuses binary bytes."""
    if b"\0" in data:
        raise CloudFileError(f"byte {data.index(0)}: is zero, wanted text")
    if data.count(b"\r") > data.count(b"\r\n"):
        data = data.replace(b"\r", b"\n")
    return data


def behind_mark(data: bytes) -> int:
    """Where the text begins: behind a byte order mark if there is one."""
    return len(_BYTE_ORDER_MARK) if data.startswith(_BYTE_ORDER_MARK) else 0


def without_comments(block: bytes, marks: tuple[bytes, ...] = (b"#",)) -> UInt8[np.ndarray, " k"]:
    """The bytes of whole lines, with blanks for what stands behind a mark on a line."""
    raw = np.frombuffer(block, np.uint8)
    if not any(mark in block for mark in marks):
        return raw
    places = np.arange(len(raw), dtype=np.int32)
    opens = np.zeros(len(raw), bool)
    for mark in marks:
        here = raw == mark[0]
        if len(mark) == 2:
            here[:-1] &= raw[1:] == mark[1]
            here[-1:] = False
        opens |= here
    last_mark = np.maximum.accumulate(np.where(opens, places, -1))
    last_newline = np.maximum.accumulate(np.where(raw == 10, places, -1))
    return np.where(last_mark > last_newline, np.uint8(32), raw)


@dataclass(frozen=True)
class Ragged:
    """All numbers of a block of lines, and how many each filled line has."""

    values: Float64[np.ndarray, " k"]
    counts: Int64[np.ndarray, " r"]
    block: bytes
    first: int

    def line(self, row: int) -> int:
        """The number of a row's line."""
        return self.first + self.block.count(b"\n", 0, int(filled_starts(self.block)[row]))


@dataclass(frozen=True)
class Lines:
    """Filled lines of a text, from byte `begin` to `end`; `first` is the number of the first."""

    data: bytes
    begin: int
    end: int
    first: int
    count: int
    comments: bool = False

    def table(self, each: int = 0) -> Float64[np.ndarray, "n c"]:
        """All lines as rows with the same count of numbers.

        Raises CloudFileError also where these, and `each` bytes more for a row, would be too much.
        """
        table = np.empty((0, 0))
        done = 0
        for line, block in blocks(self.data, self.begin, self.end, self.first, self.comments):
            rows = _load(block, line)
            if not done:
                width = rows.shape[1]
                check_room(self.count, 8 * width + each, len(self.data), "rows")
                table = np.empty((self.count, width))
            elif rows.shape[1] != table.shape[1]:
                raise CloudFileError(
                    f"line {line}: the number of columns changed from {table.shape[1]} to "
                    f"{rows.shape[1]}"
                )
            table[done : done + len(rows)] = rows
            done += len(rows)
        return table

    def ragged(self) -> Iterator[Ragged]:
        """Rows with different counts of numbers, a block at a time."""
        for line, block in blocks(self.data, self.begin, self.end, self.first, self.comments):
            yield ragged(block, line)


class Text:
    """A text, or its part from `begin` to `end`, whose filled lines are taken one after the other.

    What follows a `#` is left out if there may be `comments`.
    """

    def __init__(
        self,
        data: bytes,
        begin: int = 0,
        first: int = 1,
        *,
        end: int | None = None,
        comments: bool = False,
    ) -> None:
        self._data, self._end, self._comments = data, end, comments
        self._at, self._line = begin, first

    def take(self, count: int, what: str) -> Lines:
        """The next `count` filled lines; an error if they are not all there."""
        begin, first, left = self._at, self._line, count
        while left:
            for line, block in blocks(self._data, self._at, self._end, self._line, self._comments):
                starts = filled_starts(block)
                if len(starts) > left:  # stops where the next filled line begins
                    end = int(starts[left])
                    self._at += end
                    self._line = line + block.count(b"\n", 0, end)
                    left = 0
                    break
                left -= len(starts)
                self._at += len(block)
                self._line = line + block.count(b"\n")
                if not left:
                    break
            else:
                what_ends = "the file ends" if self._end is None else "they end"
                raise CloudFileError(
                    f"line {self._line}: {what_ends} after {count - left} of {count} {what}"
                )
        return Lines(self._data, begin, self._at, first, count, self._comments)

    def left(self) -> int:
        """How many filled lines there are from here on."""
        found = blocks(self._data, self._at, self._end, self._line, self._comments)
        return sum(len(filled_starts(block)) for _, block in found)


def blocks(
    data: bytes, begin: int, end: int | None, line: int, comments: bool = False
) -> Iterator[tuple[int, bytes]]:
    """Whole lines, about half a megabyte at a time, with the number of the first one."""
    end = len(data) if end is None else end
    while begin < end:
        behind = block_end(data, begin, end, line)
        block = data[begin:behind]
        yield line, without_comments(block).tobytes() if comments else block
        line += block.count(b"\n")
        begin = behind


def block_end(data: bytes, begin: int, end: int, line: int) -> int:
    """Where a block of whole lines that begins at `begin` ends. Raises CloudFileError for a line
    that is too long for one."""
    if begin + _BLOCK >= end:
        return end
    newline = data.find(b"\n", begin + _BLOCK, min(end, begin + _BLOCK + _LONGEST_LINE))
    if newline >= 0:
        return newline + 1
    if begin + _BLOCK + _LONGEST_LINE >= end:
        return end
    line += data.count(b"\n", begin, begin + _BLOCK)
    raise CloudFileError(f"line {line}: is longer than {_LONGEST_LINE} bytes, the most we read")


def filled_starts(block: bytes) -> Int64[np.ndarray, " k"]:
    """Where lines that are not blank begin."""
    raw = np.frombuffer(block, np.uint8)
    starts = np.concatenate([[0], np.flatnonzero(raw[:-1] == 10) + 1])
    return starts[np.maximum.reduceat(raw, starts) > 32]


def ragged(block: bytes, line: int) -> Ragged:
    """The numbers of a block of lines, of which `line` is the first."""
    if not block.strip():
        return Ragged(np.empty(0), np.empty(0, np.int64), block, line)
    try:
        values = _numbers(block.translate(_BLANKS_TO_NEWLINES))[:, 0]
    except ValueError as error:
        where = line + bad_line(block, None, uneven=True)
        raise CloudFileError(f"line {where}: {error}") from None
    filled = np.frombuffer(block, np.uint8) > 32
    begins = filled.copy()
    begins[1:] &= ~filled[:-1]  # only the first byte of each number is left
    counts = np.add.reduceat(begins, filled_starts(block), dtype=np.int64)
    return Ragged(values, counts, block, line)


def _load(block: bytes, line: int) -> Float64[np.ndarray, "n c"]:
    if not block.strip():
        return np.empty((0, 0))
    try:
        return _numbers(block)
    except ValueError as error:
        where = line + bad_line(block, None)
        raise CloudFileError(f"line {where}: {error}") from None


def _numbers(block: bytes) -> Float64[np.ndarray, "n c"]:
    return np.loadtxt(io.BytesIO(block), comments=None, ndmin=2, encoding="latin1")


def bad_line(
    data: bytes,
    delimiter: str | None,
    columns: tuple[int, ...] | None = None,
    *,
    uneven: bool = False,
) -> int:
    """Index of the line numpy stumbled over; numpy itself counts without the blank ones.

    Only the `columns` were read, or all of them, and then as many in each line unless `uneven`.
    """
    separator = None if delimiter is None else delimiter.encode()
    width = None
    for index, line in enumerate(data.split(b"\n")):
        cells = line.split(separator)
        if not line.strip():
            continue
        if columns is None and not uneven and width not in (None, len(cells)):
            return index
        if columns is not None and len(cells) <= max(columns):
            return index
        try:
            for cell in cells if columns is None else (cells[column] for column in columns):
                float(cell.replace(b"_", b"?"))  # Python allows 1_000, numpy does not
        except ValueError:
            return index
        width = len(cells)
    return 0
