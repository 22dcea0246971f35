"""Answers on disk: one file per method, saved during the run, so that the run can resume."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from cfr_jax.data.pairs import Pair
from cfr_jax.runtime.atomic import write_atomically

_PACKAGE = Path(__file__).parents[1]


@dataclasses.dataclass(frozen=True)
class Record:
    """The result for one pair: an answer or a failure."""

    pair: str
    """A digest of the pair, so that a changed pair is solved again."""
    transforms: list[Any] | None = None
    """(i, 4, 4), one per iteration."""
    seconds: float | None = None
    failure: str | None = None


@dataclasses.dataclass
class Records:
    """All records of one method, by the number of the pair."""

    made_with: dict[str, Any]
    started: dict[str, Any] | None = None
    missing: str | None = None
    by_pair: dict[int, Record] = dataclasses.field(default_factory=dict)
    modules: dict[str, float] | None = None
    """Seconds per pair of each part of the method."""


def digest(pair: Pair) -> str:
    """A digest of the clouds, the normals and the truth of a pair."""
    held = hashlib.sha256()
    for array in (
        pair.source,
        pair.target,
        pair.source_normals,
        pair.target_normals,
        pair.transform,
    ):
        held.update(b"-" if array is None else np.ascontiguousarray(array).tobytes())
    return held.hexdigest()[:16]


def code_digest(*patterns: str) -> str:
    """A digest of all files of the package that match the patterns."""
    held = hashlib.sha256()
    for path in sorted(path for pattern in patterns for path in _PACKAGE.glob(pattern)):
        held.update(path.name.encode() + path.read_bytes())
    return held.hexdigest()[:16]


def save(path: Path, records: Records) -> None:
    """Writes the file completely or not at all; numbers keep all their digits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content = dataclasses.asdict(records)
    write_atomically(path, json.dumps(content).encode())


def load(path: Path, made_with: dict[str, Any], pairs: list[str]) -> Records:
    """The records that are still valid: made with `made_with`, for the pairs with these digests.

    Raises ValueError if the file does not hold records.
    """
    fresh = Records(made_with)
    if not path.exists():
        return fresh
    try:
        content = json.loads(path.read_text())
        if content["made_with"] != json.loads(json.dumps(made_with)):
            return fresh
        kept = {int(k): Record(**record) for k, record in content["by_pair"].items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is not a file of results ({error!r}); remove it") from error
    fresh.started, fresh.modules = content["started"], content.get("modules")
    fresh.by_pair = {k: r for k, r in kept.items() if k < len(pairs) and r.pair == pairs[k]}
    return fresh
