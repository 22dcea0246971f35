"""A pair of clouds to register, and the files that hold many pairs.

`CsvPairs` and `Hdf5Pairs` read a `Pair` only when it is accessed:

    CSV   one line per pair: the files of source and target, in any format that `cfr_jax.io` reads
          and relative to the folder of the list, then optionally 16 numbers, the true motion row by
          row. A first line `source,target,...`, empty lines, and lines that start with # are
          skipped.
    HDF5  one group per pair, with `source` (N, 3), `target` (M, 3), and optionally
          `source_normals`, `target_normals`, `transform` (4, 4), and a number `overlap`.
"""

from __future__ import annotations

import csv
import io
import os
from array import array
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from cfr_jax.data.hdf5 import reading as hdf5
from cfr_jax.geometry.motions import are_rigid, check_rigid
from cfr_jax.runtime.reading import opened
from cfr_jax.runtime.sequences import MadeOnAccess, OnDemand, Texts
from cfr_jax.runtime.words import Refused, shown

_OF_A_PAIR = ("source", "target", "source_normals", "target_normals", "transform", "overlap")
_BLOCK = 4096  # motions that are checked at a time


@dataclass(frozen=True, eq=False)
class Pair:
    """Two clouds and what is known about them; None means not known.

    `transform` is the true motion; it maps source onto target: `transform @ [x; 1]`. `overlap` is
    the share of the source that is also in the target. `clean_source` and `clean_target` are the
    whole shapes without noise or crop, each in the frame of its cloud. Units are those of the file.
    """

    name: str
    source: Float[np.ndarray, "n 3"]
    target: Float[np.ndarray, "m 3"]
    source_normals: Float[np.ndarray, "n 3"] | None = None
    target_normals: Float[np.ndarray, "m 3"] | None = None
    transform: Float[np.ndarray, "4 4"] | None = None
    overlap: float | None = None
    clean_source: Float[np.ndarray, "p 3"] | None = None
    clean_target: Float[np.ndarray, "p 3"] | None = None


def among(chosen: tuple[int, int] | None, frames: Iterable[int | str]) -> bool:
    """Whether all `frames` of a pair are numbers in the half-open range `chosen`.

    None chooses all pairs. A frame that is a name, not a number, is in no range.
    """
    return chosen is None or all(
        isinstance(frame, int) and chosen[0] <= frame < chosen[1] for frame in frames
    )


class PairFile(MadeOnAccess[Pair]):
    """The pairs of a file, in its order."""

    path: Path

    def __init__(self, path: str | Path):
        self.path = Path(path)
        if not os.path.exists(self.path):
            raise Refused(f"path: there is no file of pairs at {shown(path)}")

    @property
    def names(self) -> tuple[str, ...]:
        """What each pair is called; reads no cloud."""
        raise NotImplementedError


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


class Hdf5Pairs(PairFile):
    """Groups of an HDF5 file, in the order of their names."""

    def __init__(self, path: str | Path):
        super().__init__(path)
        self._names = tuple(sorted(hdf5.read(self.path, groups=True).groups))
        if not self._names:
            raise Refused(f"{shown(path)} has no groups; wanted one per pair: source, target, ...")

    def __len__(self) -> int:
        return len(self._names)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the groups."""
        return self._names

    def frames(self, index: int) -> tuple[str | int, str | int]:
        """Frames that the source and the target of a pair were recorded from.

        These are the group's attributes `source_frame` and `target_frame`, or names that are unique
        to the pair if it lacks them.
        """
        name = self.names[index]
        frames = [("", "source_frame"), ("", "target_frame")]
        said = hdf5.read(self.path, group=name, attributes=frames).attributes
        if len(said) == 2:
            return int(said["@source_frame"]), int(said["@target_frame"])
        return f"{name}/source", f"{name}/target"

    def _make(self, index: int) -> Pair:
        name = self.names[index]
        where = f"{shown(self.path)}, {shown(name)}"
        found = hdf5.read(self.path, group=name, arrays=_OF_A_PAIR)
        held = found.arrays
        missing = [key for key in ("source", "target") if key not in held]
        if missing:
            raise Refused(f"{where} lacks {missing}, and holds only {sorted(found.names)}")
        for key in ("source", "target", "source_normals", "target_normals"):
            if key in held:
                held[key] = _checked_rows(
                    held[key], like=held[key.split("_")[0]], where=where, key=key
                )
        truth, overlap = held.get("transform"), held.get("overlap")
        if overlap is not None and (overlap.size != 1 or not np.isfinite(overlap).all()):
            raise Refused(f"{where}: overlap has the shape {overlap.shape}, wanted one number")
        return Pair(
            name=name,
            source=held["source"],
            target=held["target"],
            source_normals=held.get("source_normals"),
            target_normals=held.get("target_normals"),
            transform=None if truth is None else check_rigid(f"{where}: transform", truth),
            overlap=None if overlap is None else float(overlap.reshape(())),
        )


def with_truth(held: PairFile, index: int) -> Pair:
    """Pair `index`. Raises ValueError if its true transform is not known."""
    pair = held[index]
    if pair.transform is None:
        raise ValueError(f"{held.path}: {pair.name} has no true transform to learn from")
    return pair


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


def _checked_rows(
    values: np.ndarray, like: np.ndarray, where: str, key: str
) -> Float[np.ndarray, "n 3"]:
    wanted = (len(like), 3) if like.ndim else (0, 3)
    if values.shape != wanted or not len(values) or values.dtype.kind not in "fiu":
        raise ValueError(f"{where}: {key} is {values.dtype} {values.shape}, wanted numbers (N, 3)")
    if not np.isfinite(values).all():
        raise ValueError(f"{where}: {key} holds numbers that are not finite")
    return (
        values if values.dtype.itemsize > 2 and values.dtype.kind == "f" else values.astype(float)
    )
