"""A CSV list with one pair of files per line (`data.pairs`)."""

from __future__ import annotations

import functools
import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cfr_jax.data.kinds.kind import DataKind, Listing
from cfr_jax.runtime.messages import Refused, shown
from cfr_jax.runtime.reading import opened
from cfr_jax.runtime.sequences import OnDemand

if TYPE_CHECKING:
    from cfr_jax.data.pairs import Pair
    from cfr_jax.data.scenes import SceneSource

_SUFFIXES = (".csv", ".tsv", ".txt")


def recognize(path: Path) -> str | None:
    """Looks at the suffix and counts the lines, but does not check whether each is a pair."""
    if not path.is_file() or path.suffix.lower() not in _SUFFIXES:
        return None
    count = 0
    try:
        with opened(path) as stream, io.TextIOWrapper(stream, "utf-8-sig") as text:
            for line in text:
                count += bool(line.strip()) and not line.startswith("#")
    except UnicodeDecodeError:
        return None
    except Refused as error:
        return "a list of 0 lines" if str(error) == "is empty" else None
    return f"a list of {count} lines, one pair per line"


def train(path: str | Path, cache: Path, *, frames: tuple[int, int] | None = None) -> SceneSource:
    """All pairs. Each needs its true transform. A list has no frame numbers, so `frames` raises
    ValueError."""
    from cfr_jax.data.pairs import CsvPairs, with_truth
    from cfr_jax.data.scenes import scene_source

    held = CsvPairs(path)
    _refuse(frames, path)
    places = [[(held.path.parent / name).resolve() for name in pair] for pair in held.listed]
    return scene_source(
        path,
        names=held.names,
        frames=[tuple((str(place),) for place in pair) for pair in places],
        read=functools.partial(with_truth, held),
        files=[held.path, *sorted({place for pair in places for place in pair})],
    )


def evaluate(
    path: str | Path, cache: Path, *, frames: tuple[int, int] | tuple[()] | None = None
) -> Sequence[Pair]:
    """All pairs of the list."""
    from cfr_jax.data.pairs import CsvPairs

    held = CsvPairs(path)
    _refuse(frames, path)
    return held


def list_pairs(path: Path) -> Listing:
    """The two files of each line. Raises ValueError if none of all these files exists."""
    from cfr_jax.data.pairs import CsvPairs

    held = CsvPairs(path)
    listed = held.listed
    if not any(os.path.exists(path.parent / file) for pair in listed for file in pair):
        raise Refused(
            f"{shown(path)}: none of the files of its {len(held)} pairs exists, such as "
            f"{shown(path.parent / listed[0][0])}\n"
            "wanted lines of `source,target`, paths relative to the folder of the list"
        )

    def places(row: int) -> tuple[Path, Path]:
        source, target = listed[row]
        return path.parent / source, path.parent / target

    return Listing(listed, OnDemand(len(held), places), "pairs of a list")


def _refuse(frames: object, path: str | Path) -> None:
    if frames:
        raise ValueError(
            f"frames: {path} does not say from which frames its pairs come; "
            "make a separate list for each use"
        )


KIND = DataKind(
    name="pair-list",
    words="a CSV list of `source,target` lines",
    recognize=recognize,
    train=train,
    evaluate=evaluate,
    example="eval_scans_rgbd.py",
    list_pairs=list_pairs,
)
