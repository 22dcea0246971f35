"""The data that a config asks for: a path to a corpus of shapes, or named sources of any kind.

    data.train = "train.h5"
    data.train = {"street": {"kind": "kitti", "path": ..., "frames": (0, 45), "repeat": 4}, ...}

`repeat` says how many times an epoch each pair of a source comes; 0 leaves the source out.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import ml_collections
import numpy as np

from cfr_jax.data import protocol
from cfr_jax.data.augment import Sampling
from cfr_jax.data.batches import Mixture, ShapeSource, Source
from cfr_jax.data.corpus import read_corpus
from cfr_jax.neighbors import nearest_on_host
from cfr_jax.training import scenes

KINDS = ("shapes", "pairs", "kitti", "scans")


def open_mixture(given: Any, cache: Path, where: str) -> Mixture:
    """The sources of `data.train` or `data.validation` (`where`) as one.

    Refined truths are kept in the folder `cache`. Raises ValueError, naming the field, where a
    source is not as it should be, and OSError where it cannot be read.
    """
    sources, repeats = [], []
    for name, about in _named(given, where).items():
        kind, repeat = about.pop("kind", "shapes"), about.pop("repeat", 1)
        if not isinstance(repeat, int) or repeat < 0:
            raise ValueError(f"{where}.{name}.repeat: got {repeat!r}, wanted 0 or more times")
        if repeat:
            sources.append(_open(kind, about, cache, f"{where}.{name}"))
            repeats.append(repeat)
    if not sources:
        raise ValueError(f"{where}: no source; wanted a path, or sources by name")
    return Mixture(sources, repeats)


def check_apart(train: Mixture, validation: Mixture) -> None:
    """Raises ValueError where a scan that is validated on is trained on, too."""
    used, held = (
        {
            frame
            for source in mixture.sources
            if isinstance(source, scenes.SceneSource)
            for pair in source.frames
            for frame in pair
        }
        for mixture in (train, validation)
    )
    if used & held:
        raise ValueError(
            f"data.validation: {len(used & held)} of its {len(held)} scans are in data.train, too; "
            "wanted scans of its own (see `frames`)"
        )


def fixed_pairs(mixture: Mixture, count: int, points: int, neighbors: int, radius: float) -> dict:
    """The same `count` pairs every time, spread over the sources, as one batch.

    Shapes by the fixed partial protocol, 717 points; scans whole, at `points` points and up to 45
    degrees about each axis. One batch holds clouds of one size: either shapes or scans.
    """
    sampling = None
    if any(not isinstance(source, ShapeSource) for source in mixture.sources):
        sampling = Sampling(
            points=points,
            neighbors=min(neighbors, points - 1),
            radius=radius,
            keep=(1.0, 1.0),
            translation=0.1,
            noise=(0.0, 0.0),
        )
        if any(isinstance(source, ShapeSource) for source in mixture.sources):
            raise ValueError("data.validation: mixes shapes with scans, wanted either")
    whole = Mixture(mixture.sources, [1] * len(mixture.sources))
    chosen = np.linspace(0, len(whole) - 1, min(count, len(whole))).astype(int)
    pairs = []
    for index in chosen.tolist():
        if sampling is None:
            pairs.append(_protocol_pair(*whole.locate(index), neighbors, radius))
        else:
            pairs.append(whole.draw(index, sampling, np.random.default_rng(index)))
    return {key: np.stack([pair[key] for pair in pairs]) for key in pairs[0]}


def _protocol_pair(source: Any, index: int, neighbors: int, radius: float) -> dict:
    pair = protocol.fixed_pair(source.corpus, index, protocol.partial)
    made = {"transform": pair.transform, "estimate_normals": False}
    for side in ("source", "target"):
        cloud = made[side] = getattr(pair, side)
        made[f"{side}_normals"] = getattr(pair, f"{side}_normals")
        made[f"{side}_neighbors"] = nearest_on_host(cloud, neighbors, radius=radius)
    return made


def _named(given, where):
    if isinstance(given, str | Path):
        return {"shapes": {"kind": "shapes", "path": given}}
    if isinstance(given, ml_collections.ConfigDict):
        given = given.to_dict()
    if not isinstance(given, dict) or not all(isinstance(about, dict) for about in given.values()):
        raise ValueError(f"{where}: got {given!r}, wanted a path, or sources by name")
    return {name: dict(about) for name, about in given.items()}


def _open(kind, about, cache, where):
    makers: dict[str, Callable[..., Source]] = {
        "shapes": lambda path: ShapeSource(read_corpus(path)),
        "pairs": scenes.pairs_source,
        "kitti": lambda path, **rest: scenes.kitti_source(path, cache=cache, **rest),
        "scans": scenes.scans_source,
    }
    if kind not in makers:
        raise ValueError(f"{where}.kind: got {kind!r}, wanted one of {', '.join(KINDS)}")
    allowed = {"path"} | {
        "pairs": {"frames"},
        "kitti": {"sequences", "distances", "stride", "frames"},
    }.get(kind, set())
    unknown, missing = set(about) - allowed, {"path"} - set(about)
    if unknown or missing:
        raise ValueError(
            f"{where}: {kind} got {sorted(about)}, wanted path, and perhaps "
            f"{', '.join(sorted(allowed - {'path'})) or 'repeat'}"
        )
    return makers[kind](about.pop("path"), **about)
