"""Builds a corpus from meshes: samples, checks and compares them, and writes HDF5 files.

The output depends only on the meshes and their names.
"""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

from cfr_jax.data.making.duplicates import drop_duplicates
from cfr_jax.data.making.samples import RECIPE, Item, sampled
from cfr_jax.data.making.shapes import Shape, name_share
from cfr_jax.runtime.atomic import unfinished
from cfr_jax.runtime.progress import Progress

VALIDATION_SHARE = 0.2
ENOUGH = 30  # validation shapes; with fewer, chance decides which weights are best
SPLITS = ("train", "val", "test")


@dataclass
class Report:
    """The outcome of a build."""

    counts: dict[str, Counter[str]] = field(default_factory=dict)  # split → category → shapes
    left_out: dict[str, str] = field(default_factory=dict)  # name → reason
    left_out_file: Path | None = None  # the list of these; None if nothing was left out

    @property
    def shapes(self) -> int:
        return sum(sum(counts.values()) for counts in self.counts.values())

    @property
    def reasons(self) -> Counter[str]:
        """How many shapes were left out for each reason.

        All that repeat another count as one, and so do all that cannot be read.
        """
        return Counter(
            "repeats another" if why.startswith("repeats ") else why.partition(": ")[0]
            for why in self.left_out.values()
        )


def choose_unseen(categories: Sequence[str]) -> tuple[str, ...]:
    """Half of the categories (rounded down), chosen by a hash of their names."""
    shuffled = sorted(set(categories), key=lambda category: name_share(category, "half"))
    return tuple(sorted(shuffled[: len(shuffled) // 2]))


def split_of(name: str, unseen: bool) -> str:
    """The split of a shape: "test" if its category is unseen, otherwise "train" or "val".

    A hash of the name puts a fifth of the seen shapes into validation.
    """
    if unseen:
        return "test"
    return "val" if name_share(name, "split") < VALIDATION_SHARE else "train"


def build(
    items: Sequence[Item],
    out: Path,
    unseen: Sequence[str] | None,
    points: int = 2048,
    quiet: bool = False,
    categories: Sequence[str] | None = None,
) -> Report:
    """Writes a corpus: `train.h5`, `val.h5` and `test.h5` into the folder `out`.

    If `unseen` is None, all shapes go into a single file `out`. `shape_names.txt` is written next
    to them, and also `left_out.txt` (`NAME.left_out.txt` for a single file), which says what was
    left out and why.

    Labels are indices into the sorted `categories`, by default those that occur. All files are
    written beside their place and moved there at the end. Those of an older build are then removed,
    so that a folder never mixes the two. Raises ValueError if no item is fit, if items share a
    name, if an unseen category has no mesh, or if a single file would give other corpora in its
    folder other categories.
    """
    categories = sorted(set(categories or ()) | {item.category for item in items})
    unknown = sorted(set(unseen or ()) - set(categories))
    if unknown:
        raise ValueError(f"unseen: no mesh is of the categories {unknown}, only of {categories}")
    repeated = [name for name, times in Counter(item.name for item in items).items() if times > 1]
    if repeated:
        raise ValueError(
            f"items: {len(repeated)} names occur twice, such as {repeated[0]!r}; wanted unique ones"
        )

    single = unseen is None
    folder = out.parent if single else out
    names = "".join(f"{name}\n" for name in categories)
    if single:
        _check_neighbors(out, names)

    held_back = frozenset(unseen or ())
    work = out.with_name(f".{out.name}.work")
    report = Report()
    kept: list[Item] = []
    shapes: list[Shape] = []
    for item, made in sampled(items, points, work, quiet):
        if isinstance(made, str):
            report.left_out[item.name] = made
        else:
            kept.append(item)
            shapes.append(made)

    def bar(pairs: Sequence[tuple[int, int]]) -> Iterable[tuple[int, int]]:
        return Progress(pairs, desc="comparing", unit=" pairs", disable=quiet)

    repeats = drop_duplicates(shapes, [item.category not in held_back for item in kept], bar)
    for row, other in repeats.items():
        report.left_out[kept[row].name] = f"repeats {kept[other].name}"
    # Ordered by a hash, so that the first rows are a fair sample of all.
    rows = sorted(
        (row for row in range(len(kept)) if row not in repeats),
        key=lambda row: name_share(kept[row].name, "order"),
    )
    if not rows:
        raise ValueError(
            f"items: none of {len(items)} meshes is fit for a corpus: {dict(report.reasons)}"
        )

    folder.mkdir(parents=True, exist_ok=True)
    fresh = folder / f".{out.name}.new"
    shutil.rmtree(fresh, ignore_errors=True)
    fresh.mkdir()
    try:
        (fresh / "shape_names.txt").write_text(names, "utf-8")
        for split in ("all",) if single else SPLITS:
            chosen = [
                row for row in rows
                if single or split == split_of(kept[row].name, kept[row].category in held_back)
            ]  # fmt: skip
            report.counts[split] = Counter(kept[row].category for row in chosen)
            if chosen:  # a corpus needs at least one shape
                path = fresh / (out.name if single else f"{split}.h5")
                _write_corpus(path, [kept[row] for row in chosen], [shapes[row] for row in chosen],
                              categories, split)  # fmt: skip
        left_out = f"{out.stem}.left_out.txt" if single else "left_out.txt"
        if report.left_out:
            lines = (f"{name}: {why}\n" for name, why in sorted(report.left_out.items()))
            (fresh / left_out).write_text("".join(lines), "utf-8")
            report.left_out_file = folder / left_out
        for name in (left_out, *([out.name] if single else [f"{split}.h5" for split in SPLITS])):
            (folder / name).unlink(missing_ok=True)
        for path in sorted(fresh.iterdir()):
            os.replace(path, folder / path.name)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
    shutil.rmtree(work, ignore_errors=True)
    return report


def _check_neighbors(out: Path, names: str) -> None:
    """Raises ValueError if other files in the folder number their categories otherwise."""
    listed = out.parent / "shape_names.txt"
    others = [path.name for path in out.parent.glob("*.h5") if path.name != out.name]
    if others and listed.is_file() and listed.read_bytes() != names.encode():
        raise ValueError(
            f"out: {listed} gives {others[0]} other categories, wanted a folder without corpora"
        )


def _write_corpus(
    path: Path, items: Sequence[Item], shapes: Sequence[Shape], categories: list[str], split: str
) -> None:
    """Writes the layout of `modelnet40_ply_hdf5_2048`, plus names, with float16 points and int8
    normals."""
    data = np.stack([shape.points for shape in shapes]).astype(np.float16)
    normal = np.round(np.stack([shape.normals for shape in shapes]) * 127).astype(np.int8)
    labels = np.array([[categories.index(item.category)] for item in items])
    chunks = (min(32, len(data)), *data.shape[1:])
    # No times and no tracking, so that the same corpus gives the same bytes.
    with (
        unfinished(path) as beside,
        h5py.File(beside, "w", libver="v110", track_order=False) as file,
    ):
        packed = {"chunks": chunks, "compression": "gzip", "track_times": False}
        file.create_dataset("data", data=data, **packed)
        file.create_dataset("normal", data=normal, **packed).attrs["scale"] = 1 / 127
        kind = np.uint8 if len(categories) <= 256 else np.uint16
        file.create_dataset("label", data=labels.astype(kind), track_times=False)
        names = [item.name for item in items]
        file.create_dataset("names", data=names, dtype=h5py.string_dtype(), track_times=False)
        file.attrs["split"] = split
        file.attrs["recipe"] = RECIPE
