"""The pairs that a configuration asks for."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tqdm import tqdm

from cfr_jax.data import kinds
from cfr_jax.data.kinds.kind import DataKind, settings_of
from cfr_jax.data.layout import recognize
from cfr_jax.data.pairs import Pair
from cfr_jax.geometry.motions import nearest_motion


def read_pairs(data: Mapping[str, Any], limit: int, cache: Path) -> list[Pair]:
    """The first `limit` pairs (0: all) of the `data` section of a config; all have a truth.

    `kind` is the name of a kind in `data.kinds`, or "auto" to recognize it by the layout of `path`,
    a file or folder. Refined truths of scans are kept in the folder `cache`. Raises ValueError if
    data are missing, and says what the folder should hold, and if a pair has no truth.
    """
    if limit < 0:
        raise ValueError(f"limit is {limit}, wanted 0 for all pairs, or how many")
    kind = _chosen(data)
    assert kind.evaluate is not None  # `_chosen` takes no other kind
    needed, allowed = settings_of(kind.evaluate)
    if missing := sorted(needed - set(data)):
        raise ValueError(
            f"data lacks {', '.join(missing)}, which data of the kind {kind.name} need; for an "
            f"example see configs/{kind.example}"
        )
    settings = {name: data[name] for name in allowed if name in data}
    pairs = kind.evaluate(data["path"], cache, **settings)
    count = min(limit or len(pairs), len(pairs))
    if not count:
        raise ValueError(f"data: there is no pair in {data['path']}")
    return [_checked(pairs[i]) for i in tqdm(range(count), "making pairs", disable=None)]


def _chosen(data: Mapping[str, Any]) -> DataKind:
    if missing := sorted({"kind", "path"} - set(data)):
        raise ValueError(f"data lacks {', '.join(missing)}, which all data need")
    able = [kind for kind in kinds.entries() if kind.evaluate is not None]
    if data["kind"] != "auto":
        return kinds.named(data["kind"], "data.kind", able)
    layout = recognize(data["path"])
    if layout.kind not in able:
        raise ValueError(
            f"data.path: {layout}, which have no truth to measure against; wanted a list of pairs "
            "with their transforms, or a corpus (`cfr data build` makes one from meshes)"
        )
    print(f"recognized  {layout}")
    return layout.kind


def _checked(pair: Pair) -> Pair:
    if pair.transform is None:
        raise ValueError(f"pair {pair.name} has no true transform to measure against")
    # Make it rigid in float64: between equal rotations rounded to float32, the measured angle can
    # be up to 0.03 degrees.
    return dataclasses.replace(pair, transform=nearest_motion(pair.transform))
