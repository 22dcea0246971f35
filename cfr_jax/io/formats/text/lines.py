"""Rows of numbers in text, read by numpy's parser; a mistake is told by its line."""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64, Int64

from cfr_jax.io.cloud import CloudFileError

_BLANKS_TO_NEWLINES = bytes.maketrans(b" \t\v\f", b"\n\n\n\n")
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"


def clean_text(data: bytes) -> bytes:
    """Lines that end in a newline only, without a byte order mark; refuses binary bytes."""
    if b"\0" in data:
        raise CloudFileError(f"byte {data.index(0)}: is zero, wanted text")
    data = data.removeprefix(_BYTE_ORDER_MARK)
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return data


@dataclass(frozen=True)
class Lines:
    """The filled lines of a text, to be taken in runs; `first` is the number of the text's
    first line within its file."""

    data: bytes
    first: int = 1

    @cached_property
    def starts(self) -> Int64[np.ndarray, " k"]:
        """Byte offset of each line that is not blank."""
        if not self.data:
            return np.empty(0, np.int64)
        raw = np.frombuffer(self.data, np.uint8)
        starts = np.concatenate([[0], np.flatnonzero(raw == 10) + 1])
        starts = starts[starts < len(raw)]
        return starts[np.maximum.reduceat(raw, starts) > 32]

    def __len__(self) -> int:
        return len(self.starts)

    def run(self, begin: int, count: int, what: str) -> Lines:
        """Lines `begin` to `begin + count`; an error if they are not all there."""
        if begin + count > len(self):
            line = self.first + self.data.count(b"\n")
            raise CloudFileError(
                f"line {line}: the file ends after {len(self) - begin} of {count} {what}"
            )
        if count == 0:
            return Lines(b"", self.first)
        start = int(self.starts[begin])
        end = int(self.starts[begin + count]) if begin + count < len(self) else len(self.data)
        return Lines(self.data[start:end], self.first + self.data.count(b"\n", 0, start))

    def table(
        self, *, delimiter: str | None = None, columns: tuple[int, ...] | None = None
    ) -> Float64[np.ndarray, "n c"]:
        """All lines as rows with the same count of numbers."""
        if not self.data.strip():
            return np.empty((0, 0))
        try:
            return _load(self.data, delimiter, columns)
        except ValueError as error:
            where = self.first + bad_line(self.data, delimiter, columns)
            raise CloudFileError(f"line {where}: {error}") from None

    def rows(self) -> tuple[Float64[np.ndarray, " k"], Int64[np.ndarray, " r"]]:
        """Rows with different counts of numbers: all numbers, and where each row starts."""
        if not self.data.strip():
            return np.empty(0), np.empty(0, np.int64)
        try:
            values = _load(self.data.translate(_BLANKS_TO_NEWLINES), None, None).ravel()
        except ValueError as error:
            where = self.first + bad_line(self.data, None, (0,))
            raise CloudFileError(f"line {where}: {error}") from None
        filled = np.frombuffer(self.data, np.uint8) > 32
        filled[1:] &= ~filled[:-1]  # only the first byte of each number is left
        return values, np.searchsorted(np.flatnonzero(filled), self.starts)


def _load(
    data: bytes, delimiter: str | None, columns: tuple[int, ...] | None
) -> Float64[np.ndarray, "n c"]:
    return np.loadtxt(
        io.BytesIO(data),
        comments=None,
        delimiter=delimiter,
        usecols=columns,
        ndmin=2,
        encoding="latin1",
    )


def bad_line(data: bytes, delimiter: str | None, columns: tuple[int, ...] | None) -> int:
    """Index of the line numpy stumbled over; numpy itself counts without the blank ones."""
    separator = None if delimiter is None else delimiter.encode()
    width = None
    for index, line in enumerate(data.split(b"\n")):
        cells = line.split(separator)
        if not line.strip():
            continue
        try:
            for cell in cells:
                float(cell.replace(b"_", b"?"))  # Python allows 1_000, numpy does not
        except ValueError:
            return index
        if columns is None and width not in (None, len(cells)):
            return index
        if columns is not None and len(cells) <= max(columns):
            return index
        width = len(cells)
    return 0
