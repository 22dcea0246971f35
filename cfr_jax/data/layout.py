"""Recognizes what a file or folder holds from its layout. The kinds are in `data.kinds`."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from cfr_jax.data import kinds
from cfr_jax.data.kinds.kind import DataKind
from cfr_jax.runtime.messages import Refused, shown
from cfr_jax.runtime.reading import irregular


@dataclass(frozen=True)
class Layout:
    """The kind of data that was recognized at a path."""

    kind: DataKind
    path: Path
    found: str
    """What was found, in words, for users who want to know how their data was interpreted."""

    def __str__(self) -> str:
        return f"{self.path}: {self.found}"


def recognize(path: str | Path, kind: str | None = None) -> Layout:
    """The layout of a file or folder. If `kind` is given, no other kind is tried.

    Raises ValueError, saying what is there and what was wanted, if nothing is there, if no kind is
    recognized, or if the data is not of the given `kind`.
    """
    path = Path(path)
    if kind is not None:
        chosen = kinds.named(kind, "layout", kinds.entries())
        if (found := chosen.recognize(_existing(path))) is not None:
            return Layout(chosen, path, found)
        raise ValueError(f"{path} does not have the layout of {kind}: it holds {_contents(path)}")
    _existing(path)
    for each in kinds.entries():
        found = each.recognize(path)
        if found is not None and not (each.unlikely is not None and each.unlikely(path)):
            return Layout(each, path, found)
    *words, last = (each.words for each in kinds.entries())
    raise ValueError(
        f"{path} does not hold data of a known kind: it holds {_contents(path)}\n"
        f"wanted {', '.join(words)}, or {last}"
    )


def _existing(path: Path) -> Path:
    if not os.path.exists(path):
        raise Refused(f"there is no file or folder {shown(path)}")
    if (what := irregular(path)) is not None:
        raise Refused(f"{shown(path)} is {what}, wanted a file or a folder")
    return path


def _contents(path: Path) -> str:
    if path.is_file():
        size = path.stat().st_size
        return f"{size} bytes, suffix {path.suffix!r}" if size else "nothing (0 bytes)"
    kinds = Counter(file.suffix.lower() or "no suffix" for file in path.iterdir())
    told = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common(5))
    return told or "nothing"
