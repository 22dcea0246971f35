"""CSV lists of pairs: one line per pair, with the files of source and target.

The files may be in any format that `cfr_jax.io` reads; their names are relative to the folder of
the list. Then optionally 16 numbers follow, the true motion row by row. A first line
`source,target,...`, empty lines, and lines that start with # are skipped.
"""

from __future__ import annotations

import csv
import io
from array import array
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from cfr_jax.data.pairs.pair import Pair, PairFile
from cfr_jax.geometry.motions import are_rigid, check_rigid
from cfr_jax.runtime.messages import Refused, shown
from cfr_jax.runtime.reading import opened
from cfr_jax.runtime.sequences import OnDemand, Texts

_BLOCK = 4096  # motions that are checked at a time


class CsvPairs(PairFile):
    """A list of pairs. The list is checked when it is opened, and each cloud when it is read.

    A list of a million pairs takes little memory: names are kept as bytes, one after the other.
    """

    def __init__(self, path: str | Path):
        super().__init__(path)
        self._sources, self._targets = Texts(), Texts()
        self._truths = _Truths(shown(path))
        try:
            with (
                opened(self.path) as stream,
                io.TextIOWrapper(stream, "utf-8-sig", newline="") as text,
            ):
                self._read_rows(csv.reader(text))
        except (UnicodeDecodeError, csv.Error) as error:
            raise Refused(f"{shown(path)} is not a CSV list ({error})") from error
        except Refused as error:
            told = str(error)
            if told == "is empty":
                told = "lists no pairs; wanted lines of `source,target`"
            raise (error if shown(path) in told else Refused(f"{shown(path)} {told}")) from None
        if not self._sources:
            raise Refused(f"{shown(path)} lists no pairs; wanted lines of `source,target`")

    def _read_rows(self, reader: Any) -> None:
        path = shown(self.path)
        for cells in reader:
            row = _parse_row([cell.strip() for cell in cells], path, reader.line_num)
            if row is not None:
                source, target, numbers = row
                self._sources.append(source)
                self._targets.append(target)
                self._truths.append(numbers, reader.line_num)
        self._truths.check()

    def __len__(self) -> int:
        return len(self._sources)

    @property
    def names(self) -> tuple[str, ...]:
        """Source and target of each pair, with an arrow between them."""
        return tuple(" -> ".join(pair) for pair in self.listed)

    @property
    def listed(self) -> Sequence[tuple[str, str]]:
        """Source and target of each pair, as written in the list."""
        return OnDemand(len(self), lambda row: (self._sources[row], self._targets[row]))

    def _make(self, index: int) -> Pair:
        from cfr_jax.io import read  # imported here: a list alone does not need the readers

        source_file, target_file = self.listed[index]
        source = read(self.path.parent / source_file)
        target = read(self.path.parent / target_file)
        return Pair(
            name=f"{source_file} -> {target_file}",
            source=source.points,
            target=target.points,
            source_normals=source.normals,
            target_normals=target.normals,
            transform=self._truths[index],
        )


class _Truths:
    """The true motion of each line of a list, if it has one, checked many at a time."""

    def __init__(self, path: str):
        self._path = path
        self._rows, self._lines, self._numbers = array("q"), array("q"), array("d")
        self._checked = 0

    def append(self, numbers: list[float] | None, line: int) -> None:
        """Adds the numbers of a line, or None."""
        self._rows.append(-1 if numbers is None else len(self._lines))
        if numbers is not None:
            self._lines.append(line)
            self._numbers.extend(numbers)
            if len(self._lines) - self._checked >= _BLOCK:
                self.check()

    def check(self) -> None:
        """Raises ValueError, naming the line, if one that was not checked yet is no motion."""
        start, self._checked = self._checked, len(self._lines)
        held = np.array(self._numbers[16 * start :]).reshape(-1, 4, 4)
        if are_rigid(held).all():
            return
        for line, motion in zip(self._lines[start:], held, strict=True):
            check_rigid(f"{self._path}, line {line}: transform", motion)

    def __getitem__(self, index: int) -> Float[np.ndarray, "4 4"] | None:
        place = self._rows[index]
        if place < 0:
            return None
        return np.array(self._numbers[16 * place : 16 * place + 16]).reshape(4, 4)


def _parse_row(
    cells: list[str], path: str, line: int
) -> tuple[str, str, list[float] | None] | None:
    """Source, target and the numbers of a line, or None if the line is not a pair."""
    header = line == 1 and [cell.lower() for cell in cells[:2]] == ["source", "target"]
    if header or not any(cells) or cells[0].startswith("#"):
        return None
    source, target, *numbers = [*cells, ""][:2] + cells[2:]
    where = f"{path}, line {line}"
    if not source or not target:
        raise Refused(f"{where}: wanted `source,target`, got {shown(repr(','.join(cells)))}")
    if not any(numbers):
        return source, target, None
    try:
        values = [float(number) for number in numbers]
    except ValueError as error:
        told = shown(error)
        raise Refused(f"{where}: {told}; wanted 16 numbers after the two files") from error
    if len(values) != 16:
        raise Refused(f"{where}: got {len(values)} numbers after the two files, wanted 16 or none")
    return source, target, values
