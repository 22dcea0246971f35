"""Corpora of shapes: point clouds of equal size with normals, read from HDF5 files.

The layout is that of `modelnet40_ply_hdf5_2048` (Qi et al., 2017), one row per shape:

    data    (S, P, 3)  float, x y z
    normal  (S, P, 3)  float, or int8 with an attribute `scale`
    label   (S,) or (S, 1)  integers, line numbers (from 0) in `shape_names.txt` beside the file
    names   (S,)  strings, optional

Several files can form one corpus. Their categories are matched by name.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from jaxtyping import Float, Float32, Int

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
    if not path.is_file():
        raise ValueError(f"no corpus at {path}. {LAYOUT}")
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise ValueError(f"{path} is not an HDF5 file ({error}). {LAYOUT}") from error
    with file:
        missing = [key for key in ("data", "normal", "label") if key not in file]
        if missing:
            raise ValueError(f"{path} lacks {missing}, and holds only {sorted(file)}. {LAYOUT}")
        points = file["data"][()].astype(np.float32)
        scale = np.float32(file["normal"].attrs.get("scale", 1.0))
        normals = file["normal"][()].astype(np.float32) * scale
        labels = file["label"][()].reshape(-1).astype(np.int64)
        names = file["names"].asstr()[()] if "names" in file else None

    if points.ndim != 3 or points.shape[-1] != 3 or 0 in points.shape:
        raise ValueError(f"{path}: `data` has shape {points.shape}, wanted (S, P, 3)")
    if normals.shape != points.shape:
        raise ValueError(
            f"{path}: `normal` has shape {normals.shape}, wanted that of `data`, {points.shape}"
        )
    if len(labels) != len(points):
        raise ValueError(f"{path}: {len(labels)} labels for {len(points)} shapes")
    if names is not None and len(names) != len(points):
        raise ValueError(f"{path}: {len(names)} names for {len(points)} shapes")
    for key, values in (("data", points), ("normal", normals)):
        if not np.isfinite(values).all():
            raise ValueError(f"{path}: `{key}` holds numbers that are not finite")
    return Corpus(
        points=points,
        normals=_unit(normals),
        labels=labels,
        names=tuple(names) if names is not None else _row_names(path, len(points)),
        categories=_categories(path, labels),
    )


def _unit(vectors: Float[np.ndarray, "s p 3"]) -> Float32[np.ndarray, "s p 3"]:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)


def _row_names(path: Path, count: int) -> tuple[str, ...]:
    return tuple(f"{path.name}:{row}" for row in range(count))


def _categories(path: Path, labels: Int[np.ndarray, " s"]) -> tuple[str, ...]:
    if labels.min() < 0:
        raise ValueError(f"{path}: label {labels.min()} is negative")
    listed = path.parent / "shape_names.txt"
    if not listed.is_file():
        return tuple(str(label) for label in range(labels.max() + 1))
    categories = tuple(line.strip() for line in listed.read_text().splitlines() if line.strip())
    if labels.max() >= len(categories):
        raise ValueError(
            f"{path}: label {labels.max()} has no line in {listed}, which lists {len(categories)} "
            "categories"
        )
    return categories
