"""Corpora of shapes: point clouds of equal size with normals, read from HDF5 files.

The layout is that of `modelnet40_ply_hdf5_2048` (Qi et al., 2017), one row per shape:

    data    (S, P, 3)  float, x y z
    normal  (S, P, 3)  float, or int8 with an attribute `scale`
    label   (S,) or (S, 1)  integers, line numbers (from 0) in `shape_names.txt` beside the file
    names   (S,)  strings, optional

Several files can form one corpus. Their categories are matched by name.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int

from cfr_jax.data.hdf5 import reading as hdf5
from cfr_jax.io.cloud import LARGEST_COORDINATE
from cfr_jax.runtime.messages import Refused, shown
from cfr_jax.runtime.reading import text

_LARGEST_LABEL = 65_535  # where no file lists the categories
_LARGEST_LIST = 1 << 20  # bytes

LAYOUT = (
    "A corpus is an HDF5 file with `data` (S, P, 3), `normal` (S, P, 3) and `label` (S,), "
    "and a `shape_names.txt` beside it with one category per line."
)


@dataclass(frozen=True, eq=False)
class Corpus:
    """S shapes of P points each.

    Normals have unit length, or are zero where the file's normal is zero. `categories[labels[s]]`
    is the category of shape `s`, and `names[s]` says where it came from.
    """

    points: Float32[np.ndarray, "s p 3"]
    normals: Float32[np.ndarray, "s p 3"]
    labels: Int[np.ndarray, " s"]
    names: tuple[str, ...]
    categories: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(
        self, index: int
    ) -> tuple[Float32[np.ndarray, "p 3"], Float32[np.ndarray, "p 3"]]:
        """Points and normals of one shape."""
        return self.points[index], self.normals[index]

    def take(self, rows: slice | Sequence[int] | np.ndarray) -> Corpus:
        """A corpus with some of the shapes. `rows` is a slice, indices, or a mask."""
        kept = np.arange(len(self))[rows]
        return Corpus(
            points=self.points[kept],
            normals=self.normals[kept],
            labels=self.labels[kept],
            names=tuple(self.names[i] for i in kept),
            categories=self.categories,
        )

    def of_categories(self, categories: Iterable[str]) -> Corpus:
        """The shapes of these categories, in their present order.

        Raises ValueError for a category that the corpus does not have.
        """
        wanted = list(categories)
        unknown = sorted(set(wanted) - set(self.categories))
        if unknown:
            raise ValueError(
                f"categories: {unknown} are not in the corpus, wanted some of {self.categories}"
            )
        return self.take(np.isin(self.labels, [self.categories.index(c) for c in wanted]))


def read_corpus(paths: str | Path | Iterable[str | Path]) -> Corpus:
    """Reads a corpus from a file, from several files in the given order, or from a folder.

    In a folder, all `.h5` and `.hdf5` files are read in the order of their names. Normals are
    scaled to unit length. If a file has no names, they become `file:row`. If there is no
    `shape_names.txt`, the categories are named by their numbers. Raises ValueError if a file is
    missing, does not have this layout, or holds numbers that are not finite.
    """
    parts = [_read_file(path) for path in _files(paths)]
    sizes = {part.points.shape[1] for part in parts}
    if len(sizes) > 1:
        raise ValueError(
            f"paths: these files have shapes of {sizes} points, wanted the same number in all files"
        )
    categories = tuple(dict.fromkeys(c for part in parts for c in part.categories))
    renumbered = [
        np.array([categories.index(c) for c in part.categories], np.int64)[part.labels]
        for part in parts
    ]
    return Corpus(
        points=np.concatenate([part.points for part in parts]),
        normals=np.concatenate([part.normals for part in parts]),
        labels=np.concatenate(renumbered),
        names=tuple(name for part in parts for name in part.names),
        categories=categories,
    )


def _files(paths: str | Path | Iterable[str | Path]) -> list[Path]:
    if not isinstance(paths, (str, Path)):
        files = [Path(path) for path in paths]
        if not files:
            raise ValueError(f"paths: got no path, wanted at least one. {LAYOUT}")
        return files
    path = Path(paths)
    if not path.is_dir():
        return [path]
    files = sorted(file for file in path.iterdir() if file.suffix in (".h5", ".hdf5"))
    if not files:
        raise ValueError(f"no .h5 file in folder {path}. {LAYOUT}")
    return files


def _read_file(path: Path) -> Corpus:
    if not os.path.exists(path):
        raise Refused(f"no corpus at {shown(path)}. {LAYOUT}")
    try:
        held = hdf5.read(
            path,
            arrays=("data", "normal", "label"),
            texts=("names",),
            attributes=[("normal", "scale")],
        )
    except Refused as error:
        raise Refused(f"{error}. {LAYOUT}") from error
    try:
        return _corpus_of(held, path)
    except ValueError as error:
        raise Refused(f"{shown(path)}: {error}") from error


def _corpus_of(held: hdf5.Held, path: Path) -> Corpus:
    missing = [key for key in ("data", "normal", "label") if key not in held.arrays]
    if missing:
        raise Refused(f"it lacks {missing}, and holds only {sorted(held.names)}. {LAYOUT}")
    points, normals, labels = (held.arrays[key] for key in ("data", "normal", "label"))
    names = held.texts.get("names")
    if points.ndim != 3 or points.shape[-1] != 3 or 0 in points.shape:
        raise Refused(f"`data` has shape {points.shape}, wanted (S, P, 3)")
    if normals.shape != points.shape:
        raise Refused(f"`normal` has shape {normals.shape}, wanted that of `data`, {points.shape}")
    if labels.dtype.kind not in "iu":
        raise Refused(f"`label` is {labels.dtype}, wanted integers")
    if labels.size != len(points):
        raise Refused(f"{labels.size} labels for {len(points)} shapes")
    if names is not None and len(names) != len(points):
        raise Refused(f"{len(names)} names for {len(points)} shapes")
    with np.errstate(over="ignore"):
        points = points.astype(np.float32)
        normals = normals.astype(np.float32) * np.float32(held.attributes.get("normal@scale", 1.0))
    for key, values in (("data", points), ("normal", normals)):
        if not np.isfinite(values).all():
            raise Refused(f"`{key}` holds numbers that are not finite in float32")
        if np.abs(values).max() > LARGEST_COORDINATE:  # whose squares are no float32 any more
            raise Refused(f"`{key}` holds numbers beyond ±{LARGEST_COORDINATE:g}")
    labels = labels.reshape(-1)
    return Corpus(
        points=points,
        normals=_unit(normals),
        labels=labels.astype(np.int64),
        names=tuple(names) if names is not None else _row_names(path, len(points)),
        categories=_categories(path, int(labels.min()), int(labels.max())),
    )


def _unit(vectors: Float[np.ndarray, "s p 3"]) -> Float32[np.ndarray, "s p 3"]:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)


def _row_names(path: Path, count: int) -> tuple[str, ...]:
    return tuple(f"{path.name}:{row}" for row in range(count))


def _categories(path: Path, least: int, most: int) -> tuple[str, ...]:
    """The names of the categories, for labels in this range."""
    if least < 0:
        raise Refused(f"label {least} is negative")
    listed = path.parent / "shape_names.txt"
    if not os.path.exists(listed):
        if most > _LARGEST_LABEL:
            raise Refused(
                f"label {most} is larger than {_LARGEST_LABEL}; wanted the numbers of categories "
                "from 0 on"
            )
        return tuple(str(label) for label in range(most + 1))
    try:
        lines = text(listed, _LARGEST_LIST).splitlines()
    except Refused as error:
        raise Refused(f"{shown(listed)}: {error}") from error
    categories = tuple(line.strip() for line in lines if line.strip())
    if most >= len(categories):
        raise Refused(
            f"label {most} has no line in {shown(listed)}, which lists {len(categories)} categories"
        )
    return categories
