"""Reads a result that `cfr register --json` wrote, with its two clouds, to draw it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from cfr_jax import io
from cfr_jax.cli.shared import report
from cfr_jax.geometry import motions
from cfr_jax.io import PointCloud
from cfr_jax.viewer import Scene

_LARGEST_FILE = 1 << 26  # bytes; a result has a few thousand
_NEEDED: dict[str, type | tuple[type, ...]] = {
    "source": dict,
    "target": dict,
    "transform": list,
    "transforms": list,
    "refined": bool,
    "fitness": (int, float),
    "inlier_distance": (int, float),
    "warnings": list,
    "seed": int,
}
_COMPARED = 2_000  # points of the source whose distances are measured again
# The result was measured on thinned clouds, but here on all points: so a good fit may look a little
# better or worse. A changed file makes a much larger difference.
_WORSE = 0.25


def read_result(path: Path) -> dict[str, Any]:
    """The document in `path`; raises a ValueError that names the file if it holds anything else."""
    try:
        if path.is_dir():
            raise ValueError("is a folder")
        if path.stat().st_size > _LARGEST_FILE:
            raise ValueError("is too large")
        document = json.loads(path.read_bytes())
        if not isinstance(document, dict):
            raise ValueError(f"holds a {type(document).__name__}")
        if document.get("format") != report.FORMAT:
            raise ValueError(f"its format is {document.get('format')!r}, not {report.FORMAT!r}")
        for name, kind in _NEEDED.items():
            if not isinstance(document.get(name), kind):
                raise ValueError(f'has no usable "{name}"')
        for role in ("source", "target"):
            if not isinstance(document[role].get("path"), str):
                raise ValueError(f'does not say where its "{role}" is')
            columns = document[role].get("columns", [])
            if not isinstance(columns, list) or not all(isinstance(c, str) for c in columns):
                raise ValueError(f'the "columns" of its "{role}" are not names')
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: wanted what `cfr register --json` wrote: {error}") from error
    return document


def find_cloud(document: dict[str, Any], role: str, result: Path, given: Path | None) -> Path:
    """The current path of the `role` ("source" or "target") of `document`.

    It is `given`, if that is not None. Otherwise it is the path in the document, seen from the
    current folder or from the folder of the result, or a file of that name beside the result.
    Raises ValueError if there is no such file.
    """
    if given is not None:
        return given
    noted = Path(document[role]["path"])
    for place in (noted, result.parent / noted, result.parent / noted.name):
        if place.exists():
            return place
    raise ValueError(
        f"{role}: {noted}, which {result.name} was made from, does not exist, nor does a file of "
        f"that name beside the result; give --{role} FILE to say where it is now"
    )


def read_clouds(document: dict[str, Any], paths: dict[str, Path]) -> dict[str, PointCloud]:
    """The two clouds, sampled as before; raises ValueError if a number of points has changed."""
    clouds = {
        role: io.read(path, seed=document["seed"], columns=document[role].get("columns"))
        for role, path in paths.items()
    }
    for role, cloud in clouds.items():
        had = document[role].get("points", len(cloud))
        if len(cloud) != had:
            raise ValueError(
                f"{role}: {paths[role]} has {len(cloud):,} points, but the result was made from "
                f"{had}; give --{role} FILE if it is a different file"
            )
    return clouds


def as_scene(document: dict[str, Any], source: PointCloud, target: PointCloud) -> Scene:
    """The scene that `report.as_scene` made of the same result, without correspondence weights.

    These weights are not saved. Raises ValueError if the transforms are not rigid motions.
    """
    stations, labels = report.way(
        document.get("initial"),
        document["transforms"],
        document["transform"] if document["refined"] else None,
    )
    try:
        facts = report.quality(SimpleNamespace(**document))
        scene = Scene(
            source=source.points,
            target=target.points,
            transforms=stations,
            labels=labels,
            facts=facts,
            source_name=source.name,
            target_name=target.name,
            warnings=[str(text) for text in [*_doubts(document, source, target)]],
        )
    except (TypeError, AttributeError) as error:
        raise ValueError(f"the result cannot be drawn: {error}") from error
    return scene


def _doubts(document: dict[str, Any], source: PointCloud, target: PointCloud) -> Iterator[str]:
    """Yields the warnings of the result, and one more if its clouds no longer fit as before."""
    yield from document["warnings"]
    rows = np.random.default_rng(0).permutation(len(source))[:_COMPARED]
    transform = np.asarray(document["transform"], np.float64)
    if transform.shape != (4, 4) or not np.isfinite(transform).all():
        return  # the scene raises the error
    moved = motions.apply(transform, source.points[rows])
    away = cKDTree(target.points).query(moved)[0]
    fitness = float((away <= document["inlier_distance"]).mean())
    if fitness < document["fitness"] - _WORSE:
        yield (
            f"the clouds do not fit as they did before (fitness {fitness:.2f}; it was "
            f"{document['fitness']:.2f}): were the files changed?"
        )
