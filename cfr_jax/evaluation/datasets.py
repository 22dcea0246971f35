"""The pairs that a configuration asks for."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from cfr_jax.data import kitti, protocol
from cfr_jax.data.corpus import Corpus, read_corpus
from cfr_jax.data.layout import recognize
from cfr_jax.data.modelnet import read_modelnet40
from cfr_jax.data.pairs import Hdf5Pairs, Pair, among, open_pairs
from cfr_jax.geometry.motions import nearest_motion

_PROTOCOLS = {
    made.name: made
    for made in (
        protocol.clean,
        protocol.noise,
        protocol.partial,
        protocol.low_overlap,
        protocol.partial_both_ways,
        protocol.partial_any_rotation,
    )
}
Make = Callable[[int], Pair]
# What `data.layout` recognizes, as the kinds of a config, and a config that has all their settings.
_RECOGNIZED = {
    "corpus": "corpus",
    "modelnet40": "modelnet40",
    "kitti": "kitti",
    "pair-list": "pairs",
    "pair-file": "pairs",
}
_CONFIGS = {
    "corpus": "eval_open_cad.py",
    "modelnet40": "eval_modelnet40.py",
    "kitti": "eval_scans_lidar.py",
    "pairs": "eval_scans_rgbd.py",
}


def read_pairs(data: Any, limit: int, cache: Path) -> list[Pair]:
    """The first `limit` pairs (0: all) of the `data` section of a config, all of them with truth.

    `data.kind` is "corpus", "modelnet40", "kitti", or "pairs", or "auto" to have it told from the
    layout of `data.path`, a file or folder. Scans have their refined truths kept in the folder
    `cache`. Raises ValueError where data is missing, with what the folder should hold, and for a
    pair without a truth.
    """
    kinds = {"corpus": _corpus, "modelnet40": _modelnet40, "kitti": _kitti, "pairs": _pairs}
    if data.kind not in (*kinds, "auto"):
        raise ValueError(f"data.kind is {data.kind!r}, wanted auto or one of {', '.join(kinds)}")
    if limit < 0:
        raise ValueError(f"limit is {limit}, wanted 0 for all pairs, or how many")
    kind = _recognized(data.path) if data.kind == "auto" else data.kind
    try:
        count, make = kinds[kind](data, cache)
    except AttributeError as error:  # of the config
        raise ValueError(
            f"data lacks a setting that {kind} data need ({error}); a config of such data is "
            f"configs/{_CONFIGS[kind]}"
        ) from None
    count = min(limit or count, count)
    if not count:
        raise ValueError(f"data: no pair in {data.path}")
    return [_checked(make(i)) for i in tqdm(range(count), "making pairs", disable=None)]


def _recognized(path: str | Path) -> str:
    layout = recognize(path)
    if layout.kind not in _RECOGNIZED:
        raise ValueError(
            f"data.path: {layout}, which have no truth to measure against; wanted a list of pairs "
            "with their transforms, or a corpus (`cfr data build` makes one of meshes)"
        )
    print(f"recognized  {layout}")
    return _RECOGNIZED[layout.kind]


def _corpus(data: Any, cache: Path) -> tuple[int, Make]:
    return _shapes(read_corpus(data.path), data)


def _modelnet40(data: Any, cache: Path) -> tuple[int, Make]:
    return _shapes(read_modelnet40(data.path, data.split), data)


def _shapes(corpus: Corpus, data: Any) -> tuple[int, Make]:
    if data.protocol not in _PROTOCOLS:
        raise ValueError(
            f"data.protocol is {data.protocol!r}, wanted one of {', '.join(_PROTOCOLS)}"
        )
    chosen = _PROTOCOLS[data.protocol]
    return len(corpus), lambda index: protocol.fixed_pair(corpus, index, chosen)


def _kitti(data: Any, cache: Path) -> tuple[int, Make]:
    parts = [
        kitti.read_pairs(
            data.path,
            sequence,
            cache=cache / f"truths_{sequence}.npz",
            distance=data.distance,
            stride=data.stride or None,
        )
        for sequence in data.sequences
    ]
    chosen = data.get("frames") or None
    places = [
        (part, index)
        for part in parts
        for index, frames in enumerate(part.frames.tolist())
        if among(chosen, frames)
    ]

    def make(index: int) -> Pair:
        part, row = places[index]
        return kitti.scan_pair(part, row, data.points, data.angle, data.translation)

    return len(places), make


def _pairs(data: Any, cache: Path) -> tuple[int, Make]:
    held: Sequence[Pair] = open_pairs(data.path)
    if not data.get("frames"):
        return len(held), held.__getitem__
    if not isinstance(held, Hdf5Pairs):
        raise ValueError(f"data.frames: {data.path} does not say from which frames its pairs are")
    rows = [row for row in range(len(held)) if among(data.frames, held.frames(row))]
    return len(rows), lambda index: held[rows[index]]


def _checked(pair: Pair) -> Pair:
    if pair.transform is None:
        raise ValueError(f"pair {pair.name} has no true transform to measure against")
    # Rigid in float64: the angle between rotations rounded to float32 reads up to 0.03 degrees.
    return dataclasses.replace(pair, transform=nearest_motion(pair.transform))
