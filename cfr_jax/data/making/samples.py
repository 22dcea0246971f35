"""Samples meshes one after another and saves the results on the way, so that an interrupted build
resumes where it stopped."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cfr_jax.data.making.shapes import Shape, Unfit, make_shape
from cfr_jax.io.mesh import Mesh
from cfr_jax.runtime.atomic import unfinished
from cfr_jax.runtime.progress import Progress

RECIPE = "1"  # incremented if the same meshes would give a different corpus
_BLOCK = 64  # meshes sampled between two saves


@dataclass(frozen=True)
class Item:
    """One mesh on its way into a corpus."""

    name: str  # unique; determines the random numbers and the split
    category: str
    load: Callable[[], Mesh]
    least_faces: int = 20
    stamp: str = ""  # changes when the file does


def sampled(
    items: Sequence[Item], points: int, work: Path, quiet: bool
) -> Iterator[tuple[Item, Shape | str]]:
    """Each item with its shape, or with the reason why it was left out.

    Results are saved in `work`, block by block, and reused by the run after an interruption.
    """
    plan = [RECIPE, points, [(i.name, i.least_faces, i.stamp) for i in items]]
    digest = hashlib.sha256(json.dumps(plan).encode()).hexdigest()
    folder = work / digest[:16]
    if work.is_dir():  # delete samples of other meshes
        for other in work.glob("[0-9a-f]" * 16):
            if other != folder:
                shutil.rmtree(other)
    folder.mkdir(parents=True, exist_ok=True)
    with Progress(total=len(items), desc="sampling", unit=" meshes", disable=quiet) as bar:
        for start in range(0, len(items), _BLOCK):
            block = items[start : start + _BLOCK]
            path = folder / f"{start:06d}.npz"
            if not path.is_file():
                _save_block(path, [_attempt(item, points, bar) for item in block], points)
            else:
                bar.update(len(block))
            yield from zip(block, _load_block(path), strict=True)


def _attempt(item: Item, points: int, bar: Progress) -> Shape | str:
    try:
        return make_shape(item.load(), item.name, points, item.least_faces)
    except Unfit as unfit:
        return str(unfit)
    except ValueError as error:
        why = " ".join(str(error).removeprefix(f"{item.name}: ").split())
        bar.write(f"left out: {item.name}: {why}") if not bar.disable else None
        return f"cannot be read: {why}"
    finally:
        bar.update(1)


def _save_block(path: Path, made: Sequence[Shape | str], points: int) -> None:
    shapes = [one for one in made if isinstance(one, Shape)]
    with unfinished(path) as beside, open(beside, "wb") as stream:
        np.savez(
            stream,
            reasons=np.array(["" if isinstance(one, Shape) else one for one in made], "U"),
            points=np.array([s.points for s in shapes], np.float32).reshape(-1, points, 3),
            normals=np.array([s.normals for s in shapes], np.float32).reshape(-1, points, 3),
            spacings=np.array([s.spacing for s in shapes], np.float64),
            fingerprints=np.array([s.fingerprint for s in shapes], "U"),
        )


def _load_block(path: Path) -> Iterator[Shape | str]:
    with np.load(path, allow_pickle=False) as saved:
        columns = ("points", "normals", "spacings", "fingerprints")
        shapes = zip(*(saved[column] for column in columns), strict=True)
        for reason in saved["reasons"].tolist():
            if reason:
                yield reason
            else:
                points, normals, spacing, fingerprint = next(shapes)
                yield Shape(points, normals, float(spacing), str(fingerprint))
