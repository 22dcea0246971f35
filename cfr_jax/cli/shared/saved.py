"""A result that `cfr register --json` wrote, and the clouds it speaks of: ready to be drawn."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from cfr_jax import io
from cfr_jax.cli.shared import report
from cfr_jax.cli.shared.transforms import is_number, matrix_of
from cfr_jax.geometry import motions
from cfr_jax.io import PointCloud
from cfr_jax.runtime.messages import Refused, shown
from cfr_jax.runtime.reading import contents, parse_json
from cfr_jax.viewer import Scene

_LARGEST_FILE = 1 << 21  # bytes; a result has a few thousand
_MOST = 1000  # of transforms and of warnings
_FARTHEST = 1e15  # larger than any translation between clouds that can be read
_COMPARED = 2_000  # points of the source whose distances are taken again
# The result measured thinned clouds, and here all points are: a good fit may look a little better
# or worse, a changed file looks like another one.
_WORSE = 0.25


def read_result(path: Path) -> dict[str, Any]:
    """The document in `path`; raises ValueError, naming the file, for anything else."""
    try:
        data = contents(path, _LARGEST_FILE)
    except Refused as error:
        raise Refused(f"{shown(path)}: {error}") from error
    try:
        document = parse_json(data)
        if not isinstance(document, dict):
            raise Refused(f"holds a {type(document).__name__}")
        if document.get("format") != report.FORMAT:
            told = shown(repr(document.get("format")))
            raise Refused(f"its format is {told}, not {report.FORMAT!r}")
        for role in ("source", "target"):
            _check_cloud(role, document.get(role))
        for name, fits in _NEEDED.items():
            if name not in document or not fits(document[name]):
                raise Refused(f'has no usable "{name}"')
        if not _is_figure(document.get("scale", 1.0), _FARTHEST):
            raise Refused('has no usable "scale"')
        _check_motions(document)
    except Refused as error:
        raise Refused(f"{shown(path)}: wanted what `cfr register --json` wrote: {error}") from error
    return document


def _check_cloud(role: str, about: Any) -> None:
    if not isinstance(about, dict):
        raise Refused(f'has no usable "{role}"')
    if not isinstance(about.get("path"), str) or "\0" in about["path"]:
        raise Refused(f'does not say where its "{role}" is')
    columns = about.get("columns", [])
    if not isinstance(columns, list) or not all(isinstance(name, str) for name in columns):
        raise Refused(f'the "columns" of its "{role}" are not names')
    if not _is_count(about.get("points", 1)):
        raise Refused(f'does not say how many points its "{role}" has')


def _check_motions(document: dict[str, Any]) -> None:
    held = {"transform": document["transform"], "initial": document.get("initial")}
    held |= {f"transforms[{row}]": value for row, value in enumerate(document["transforms"])}
    for name, value in held.items():
        if value is None and name == "initial":
            continue
        place = name.partition("[")
        try:
            found = motions.check_rigid(name, matrix_of(value))
        except ValueError as error:
            told = str(error).removeprefix(f"{name}: ")
            raise Refused(f'"{place[0]}"{place[1]}{place[2]}: {told}') from error
        if np.abs(found).max() > _FARTHEST:
            raise Refused(f'"{place[0]}": moves farther than any cloud lies')


def _is_figure(value: Any, most: float = math.inf) -> bool:
    return is_number(value) and math.isfinite(value) and 0 <= value <= most


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _is_list(value: Any) -> bool:
    return isinstance(value, list) and len(value) <= _MOST


_NEEDED: dict[str, Callable[[Any], bool]] = {
    "transform": _is_list,
    "transforms": lambda value: _is_list(value) and len(value) > 0,
    "refined": lambda value: isinstance(value, bool),
    "confidence": lambda value: value is None or _is_figure(value, 1.0),
    "fitness": lambda value: _is_figure(value, 1.0),
    "inlier_rmse": _is_figure,
    "inlier_distance": _is_figure,
    "warnings": lambda value: _is_list(value) and all(isinstance(text, str) for text in value),
    "seed": _is_count,
}


def find_cloud(document: dict[str, Any], role: str, result: Path, given: Path | None) -> Path:
    """Where the `role` ("source" or "target") of `document` lies now.

    `given` if there is one; else the path in the document, from here or from the folder of the
    result. Raises ValueError if the file is in neither place.
    """
    if given is not None:
        return given
    noted = Path(document[role]["path"])
    for place in (noted, result.parent / noted, result.parent / noted.name):
        if os.path.exists(place):
            return place
    raise Refused(
        f"{role}: {shown(noted)}, which {shown(result.name)} was made from, does not exist, nor "
        f"does a file of that name beside the result; give --{role} FILE to say where it is now"
    )


def read_clouds(document: dict[str, Any], paths: dict[str, Path]) -> dict[str, PointCloud]:
    """The two clouds, sampled as they were; ValueError if one has other points than it had."""
    clouds = {
        role: io.read(path, seed=document["seed"], columns=document[role].get("columns"))
        for role, path in paths.items()
    }
    for role, cloud in clouds.items():
        had = document[role].get("points", len(cloud))
        if len(cloud) != had:
            raise Refused(
                f"{role}: {shown(paths[role])} has {len(cloud):,} points, but the result was "
                f"made from {had:,}; give --{role} FILE if it is a different file"
            )
    return clouds


def as_scene(document: dict[str, Any], source: PointCloud, target: PointCloud) -> Scene:
    """What `report.as_scene` drew of the same result, without the correspondence weights, which
    are not saved."""
    stations, labels = report.way(
        document.get("initial"),
        document["transforms"],
        document["transform"] if document["refined"] else None,
    )
    return Scene(
        source=document.get("scale", 1.0) * source.points,
        target=target.points,
        transforms=stations,
        labels=labels,
        facts=report.quality(SimpleNamespace(**document)),
        source_name=source.name,
        target_name=target.name,
        warnings=[shown(text, 600) for text in _doubts(document, source, target)],
    )


def _doubts(document: dict[str, Any], source: PointCloud, target: PointCloud) -> Iterator[str]:
    """The warnings of the result, and one more if its clouds do not fit as they did."""
    yield from document["warnings"]
    rows = np.random.default_rng(0).permutation(len(source))[:_COMPARED]
    transform = np.asarray(document["transform"], np.float64)
    moved = motions.apply(transform, document.get("scale", 1.0) * source.points[rows])
    away = cKDTree(target.points).query(moved)[0]
    fitness = float((away <= document["inlier_distance"]).mean())
    if fitness < document["fitness"] - _WORSE:
        yield (
            f"the clouds do not fit as they did before (fitness {fitness:.2f}; it was "
            f"{document['fitness']:.2f}): were the files changed?"
        )
