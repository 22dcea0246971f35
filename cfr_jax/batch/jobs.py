"""Lists the pairs in a file or folder: their names and how to read them. Reads no cloud yet."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cfr_jax.data.layout import Layout
from cfr_jax.runtime.sequences import MadeOnAccess

_ROLE = re.compile(r"(^|[._/-])(source|src|target|tgt|dst)(?=$|[._/-])")
_TARGETS = ("target", "tgt", "dst")


@dataclass(frozen=True)
class Job:
    """A pair of a list; the names and `repeat` identify it."""

    source: str
    target: str
    repeat: int
    """How many pairs with the same names come before it in the list."""
    pair: tuple[Path, Path] | Callable[[], tuple[Any, Any]]
    """The pair in a form that `align_many` takes."""

    @property
    def key(self) -> tuple[str, str, int]:
        """The key of this pair in the journal."""
        return self.source, self.target, self.repeat


class Jobs(MadeOnAccess[Job]):
    """The pairs of a list, of which only how often each was listed before is in memory."""

    def __init__(self, names: Sequence[Sequence[str]], pairs: Sequence[Any]):
        self._names, self._pairs = names, pairs
        self._repeats = _repeats(names)

    def __len__(self) -> int:
        return len(self._pairs)

    def _make(self, index: int) -> Job:
        return Job(*self.key(index), self._pairs[index])

    def key(self, row: int) -> tuple[str, str, int]:
        """`Job.key` of a row, without its pair."""
        row = range(len(self))[row]
        source, target = self._names[row]
        return source, target, int(self._repeats[row])


def jobs_of(layout: Layout, target: Path | None = None) -> tuple[Jobs, str]:
    """The pairs of recognized data, in order, and a phrase that says what was paired with what.

    With `target`, every cloud of a folder is registered onto that one file. Raises ValueError if
    there is no pair, and for data without pairs; the message then says what such data are for.
    """
    kind = layout.kind
    if target is not None and kind.list_scans is None:
        raise ValueError(
            f"target: {layout.path} is {layout.found}, which already names its targets"
        )
    if kind.list_pairs is not None:
        listing = kind.list_pairs(layout.path)
        return Jobs(listing.names, listing.pairs), listing.how
    if kind.list_scans is not None:
        return _of_files(layout, kind.list_scans(layout.path), target)
    raise ValueError(
        f"{layout.path} is {layout.found}, not pairs\n"
        "`evaluate.py` makes pairs from shapes, and `cfr data info` shows the shapes"
    )


def _of_files(layout: Layout, files: list[Path], target: Path | None) -> tuple[Jobs, str]:
    folder = layout.path
    if target is not None:
        if not target.is_file():
            raise ValueError(f"target: there is no file {target}")
        places = [(file, target) for file in files if not file.samefile(target)]
        how = f"each of {len(places)} onto {target.name}"
    elif places := _by_name(folder, files):
        how = f"{len(places)} pairs named source and target"
    else:
        places = [
            (file, before)
            for before, file in zip(files, files[1:], strict=False)
            if file.parent == before.parent
        ]
        how = "each onto the one before it, by name"
    if not places:
        raise ValueError(
            f"{folder}: {layout.found}, but no two that could be registered onto each other\n"
            "give --target FILE, or a CSV list of `source,target` lines"
        )
    names = [tuple(_inside(folder, file) for file in place) for place in places]
    return Jobs(names, places), how


def _by_name(folder: Path, files: list[Path]) -> list[tuple[Path, Path]]:
    """Pairs of files whose names differ only in `source` and `target` (or src, tgt, dst).

    Empty unless all files form such pairs.
    """
    sides: tuple[dict[str, Path], dict[str, Path]] = {}, {}
    for file in files:
        inside = file.relative_to(folder).with_suffix("").as_posix()
        role = _ROLE.search(inside.lower())
        if role is None:
            return []
        rest = inside[: role.start(2)] + "*" + inside[role.end(2) :]
        sides[role[2] in _TARGETS][rest] = file
    if sides[0].keys() != sides[1].keys():
        return []
    return [(file, sides[1][rest]) for rest, file in sides[0].items()]


def _inside(folder: Path, file: Path) -> str:
    return str(file.relative_to(folder)) if file.is_relative_to(folder) else str(file)


def _repeats(names: Sequence[Sequence[str]]) -> np.ndarray:
    """How many pairs of the same names come before each."""
    repeats = np.zeros(len(names), np.uint32)
    hashes = np.fromiter((hash(tuple(pair)) for pair in names), np.int64, len(names))
    _, group, sizes = np.unique(hashes, return_inverse=True, return_counts=True)
    seen: Counter[tuple[str, ...]] = Counter()
    for row in np.flatnonzero(sizes[group] > 1).tolist():  # few, and equal ones are among them
        pair = tuple(names[row])
        repeats[row] = seen[pair]
        seen[pair] += 1
    return repeats
