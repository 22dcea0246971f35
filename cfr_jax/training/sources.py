"""The data that a config asks for: a path to a corpus of shapes, or named sources of any kind.

    data.train = "train.h5"
    data.train = {"street": {"kind": "kitti", "path": ..., "frames": (0, 45), "repeat": 4}, ...}

`repeat` says how many times an epoch each pair of a source comes; 0 leaves the source out.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import ml_collections
import numpy as np

from cfr_jax.data import protocol
from cfr_jax.data.augment import Sampling
from cfr_jax.data.corpus import read_corpus
from cfr_jax.data.loader import Mixture, ShapeSource, Source
from cfr_jax.geometry.neighbors import nearest_on_host
from cfr_jax.runtime.atomic import write_atomically
from cfr_jax.runtime.progress import Progress
from cfr_jax.training import scenes
from cfr_jax.training.devices import is_first

_TOLD = 10  # scans that cannot be read, by name
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


def check_readable(mixture: Mixture, cache: Path, where: str) -> None:
    """Reads every scan once, before a training would come upon a bad one in its third hour.

    What was found sound is remembered in the folder `cache`. Raises ValueError with all that cannot
    be read.
    """
    known = cache / "readable"
    sound = set(known.read_text("utf-8").split()) if known.is_file() else set()
    scans = [source for source in mixture.sources if isinstance(source, scenes.SceneSource)]
    unread = [source for source in scans if source.stamp not in sound]
    for source in unread:
        wrong = []
        for row in Progress(range(len(source)), desc=f"reading {where}", unit=" pairs"):
            try:
                source.read(row)
            except ValueError as error:
                wrong.append(str(error))
        if wrong:
            wrong = list(dict.fromkeys(wrong))
            more = f"\n... and {len(wrong) - _TOLD} more" if len(wrong) > _TOLD else ""
            raise ValueError(
                f"{where}: {len(wrong)} scans cannot be used; mend them or take them out:\n"
                + "\n".join(wrong[:_TOLD])
                + more
            )
        sound.add(source.stamp)
    if unread and is_first():
        write_atomically(known, "\n".join(sorted(sound)).encode())


def stamp(mixture: Mixture, *more: np.ndarray) -> str:
    """What tells data from other data, wherever they lie; of `more`, four decimals."""
    parts = [
        source.stamp if isinstance(source, scenes.SceneSource) else _shapes_stamp(source)
        for source in mixture.sources
    ]
    parts += [f"{np.round(array.astype(np.float64), 4).tolist()}" for array in more]
    text = "\n".join([*parts, str(list(mixture.repeats))])
    return f"{told(mixture)}, {hashlib.sha256(text.encode()).hexdigest()[:12]}"


def told(mixture: Mixture) -> str:
    """How many pairs of what kind, in words."""
    kinds: Counter[str] = Counter()
    for source, repeat in zip(mixture.sources, mixture.repeats, strict=True):
        kind = "shapes"
        if isinstance(source, scenes.SceneSource):
            kind = "single scans" if source.single else "pairs of scans"
        kinds[kind] += repeat * len(source)
    return " and ".join(f"{count} {kind}" for kind, count in kinds.items())


def fixed_pairs(
    mixture: Mixture, count: int, sampling: Sampling, neighbors: int, radius: float
) -> dict:
    """The same `count` pairs every time, spread over the sources, as one batch.

    Shapes by the fixed partial protocol, 717 points. Recorded pairs as they are, thinned to
    `sampling.points` and turned by up to 45 degrees about each axis. Of a single scan two views are
    drawn by `sampling`, as in training: whole, it would be laid on itself. One batch holds clouds
    of one size: either shapes or scans.
    """
    shapes = [isinstance(source, ShapeSource) for source in mixture.sources]
    if any(shapes) and not all(shapes):
        raise ValueError("data.validation: mixes shapes with scans, wanted either")
    fewer = min(neighbors, sampling.points - 1)
    views = dataclasses.replace(sampling, neighbors=fewer, radius=radius)
    recorded = Sampling(
        points=sampling.points,
        neighbors=fewer,
        radius=radius,
        keep=(1.0, 1.0),
        translation=0.1,
        noise=(0.0, 0.0),
    )
    whole = Mixture(mixture.sources, [1] * len(mixture.sources))
    chosen = np.linspace(0, len(whole) - 1, min(count, len(whole))).astype(int)
    pairs = []
    for index in chosen.tolist():
        source, row = whole.locate(index)
        if isinstance(source, ShapeSource):
            pairs.append(_protocol_pair(source, row, neighbors, radius))
        else:
            single = isinstance(source, scenes.SceneSource) and source.single
            drawn = views if single else recorded
            pairs.append(source.draw(row, drawn, np.random.default_rng(index)))
    return {key: np.stack([pair[key] for pair in pairs]) for key in pairs[0]}


def _protocol_pair(source: ShapeSource, index: int, neighbors: int, radius: float) -> dict:
    pair = protocol.fixed_pair(source.corpus, index, protocol.partial)
    made = {"transform": pair.transform, "estimate_normals": False}
    for side in ("source", "target"):
        cloud = made[side] = getattr(pair, side)
        made[f"{side}_normals"] = getattr(pair, f"{side}_normals")
        made[f"{side}_neighbors"] = nearest_on_host(cloud, neighbors, radius=radius)
    return made


def _shapes_stamp(source):
    corpus = source.corpus
    digest = hashlib.sha256("\n".join(corpus.names).encode())
    digest.update(corpus.points[:, ::64].tobytes())
    return digest.hexdigest()


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
    path = about.pop("path")
    if not str(path):
        raise ValueError(
            f"{where}.path: none given; wanted a file or a folder, as in --config.{where}.path=PATH"
        )
    return makers[kind](path, **about)
