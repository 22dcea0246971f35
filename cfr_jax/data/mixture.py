"""The data that a config names: a path to a corpus of shapes, or named sources of any kind.

    data.train = "train.h5"
    data.train = {"street": {"kind": "kitti", "path": ..., "frames": (0, 45), "repeat": 4}, ...}

The kinds are those of `data.kinds`; "auto" recognizes the kind from the layout of the data, and the
default is a corpus. `repeat` says how many times each item of a source comes per epoch; 0 leaves
the source out. All other entries are settings of the kind.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cfr_jax.data import kinds
from cfr_jax.data.augmentation.sampling import Sampling
from cfr_jax.data.kinds.kind import settings_of
from cfr_jax.data.layout import recognize
from cfr_jax.data.sources import TrainingSource
from cfr_jax.runtime.atomic import write_atomically
from cfr_jax.runtime.progress import Progress

_TOLD = 10  # unreadable scans that are listed by name


@dataclass(frozen=True)
class Mixture:
    """Several sources as one. Each item of source `s` comes `repeats[s]` times per epoch."""

    sources: Sequence[TrainingSource]
    repeats: Sequence[int]

    def __len__(self) -> int:
        return sum(len(s) * r for s, r in zip(self.sources, self.repeats, strict=True))

    def draw(self, index: int, sampling: Sampling, rng: np.random.Generator) -> dict[str, Any]:
        """A pair from the source that item `index` of the mixture belongs to."""
        source, index = self.locate(index)
        return source.draw(index, sampling, rng)

    def locate(self, index: int) -> tuple[TrainingSource, int]:
        """The source that item `index` of the mixture belongs to, and its index in that source."""
        for source, repeat in zip(self.sources, self.repeats, strict=True):
            if index < len(source) * repeat:
                return source, index % len(source)
            index -= len(source) * repeat
        raise IndexError(f"index: got one past the last of {len(self)} items")

    def told(self) -> str:
        """How many items of each sort there are, in words."""
        counts: Counter[str] = Counter()
        for source, repeat in zip(self.sources, self.repeats, strict=True):
            counts[source.noun] += repeat * len(source)
        return " and ".join(f"{count} {noun}" for noun, count in counts.items())

    def stamp(self, *more: np.ndarray) -> str:
        """Identifies the data regardless of its path; `more` is included to four decimals."""
        parts = [source.stamp for source in self.sources]
        parts += [f"{np.round(array.astype(np.float64), 4).tolist()}" for array in more]
        text = "\n".join([*parts, str(list(self.repeats))])
        return f"{self.told()}, {hashlib.sha256(text.encode()).hexdigest()[:12]}"


def open_mixture(given: Any, cache: Path, where: str) -> Mixture:
    """The sources of `data.train` or `data.validation` (`where`) as one mixture.

    Refined true motions are kept in the folder `cache`. Raises ValueError, naming the field, if a
    source is malformed, and OSError if it cannot be read.
    """
    sources, repeats = [], []
    for name, about in _named(given, where).items():
        repeat = about.pop("repeat", 1)
        if not isinstance(repeat, int) or repeat < 0:
            raise ValueError(f"{where}.{name}.repeat: got {repeat!r}, wanted 0 or more times")
        if repeat:
            sources.append(_open(about, cache, f"{where}.{name}"))
            repeats.append(repeat)
    if not sources:
        raise ValueError(f"{where}: no source; wanted a path, or sources by name")
    return Mixture(sources, repeats)


def check_apart(train: Mixture, validation: Mixture) -> None:
    """Raises ValueError if a scan is used for both validation and training."""
    used, held = (
        frozenset().union(*(source.recorded for source in mixture.sources))
        for mixture in (train, validation)
    )
    if used & held:
        raise ValueError(
            f"data.validation: {len(used & held)} of its {len(held)} scans are also in data.train; "
            "wanted scans that are not trained on (see `frames`)"
        )


def check_readable(mixture: Mixture, cache: Path, where: str, remember: bool = True) -> None:
    """Reads every scan once, so that a bad one does not stop a training in its third hour.

    The folder `cache` lists the sources that were readable before; they are not read again. With
    `remember`, newly checked sources are added to the list; only one of several processes should do
    that. Raises ValueError, listing the scans that cannot be used.
    """
    file = cache / "readable"
    sound = set(file.read_text("utf-8").split()) if file.is_file() else set()
    unread = [
        (source, source.check)
        for source in mixture.sources
        if source.check is not None and source.stamp not in sound
    ]
    for source, check in unread:
        _read_all(source, check, where)
        sound.add(source.stamp)
    if unread and remember:
        write_atomically(file, "\n".join(sorted(sound)).encode())


def fixed_pairs(
    mixture: Mixture, count: int, sampling: Sampling, neighbors: int, radius: float
) -> dict[str, np.ndarray]:
    """The same `count` pairs on every call, spread over the sources, as one batch.

    Each source decides how its pairs are made. All clouds in a batch must have the same size, so
    shapes and scans cannot be mixed. Raises ValueError if the sizes differ.
    """
    whole = Mixture(mixture.sources, [1] * len(mixture.sources))
    chosen = np.linspace(0, len(whole) - 1, min(count, len(whole))).astype(int)
    pairs = []
    for index in chosen.tolist():
        source, row = whole.locate(index)
        rng = np.random.default_rng(index)
        pairs.append(source.fixed_pair(row, sampling, neighbors, radius, rng))
    sizes = sorted({len(pair[side]) for pair in pairs for side in ("source", "target")})
    if len(sizes) > 1:
        raise ValueError(
            f"data.validation: its pairs have {' and '.join(map(str, sizes))} points, wanted one "
            "size: either shapes or scans"
        )
    return {key: np.stack([pair[key] for pair in pairs]) for key in pairs[0]}


def _read_all(source: TrainingSource, check: Callable[[int], object], where: str) -> None:
    wrong = []
    for row in Progress(range(len(source)), desc=f"reading {where}", unit=" pairs"):
        try:
            check(row)
        except ValueError as error:
            wrong.append(str(error))
    if wrong:
        wrong = list(dict.fromkeys(wrong))
        more = f"\n... and {len(wrong) - _TOLD} more" if len(wrong) > _TOLD else ""
        raise ValueError(
            f"{where}: {len(wrong)} scans cannot be used; repair or remove them:\n"
            + "\n".join(wrong[:_TOLD])
            + more
        )


def _named(given: Any, where: str) -> dict[str, dict[str, Any]]:
    if isinstance(given, str | Path):
        return {"corpus": {"kind": "corpus", "path": given}}
    if not isinstance(given, dict) or not all(isinstance(about, dict) for about in given.values()):
        raise ValueError(f"{where}: got {given!r}, wanted a path, or sources by name")
    return {name: dict(about) for name, about in given.items()}


def _open(about: dict[str, Any], cache: Path, where: str) -> TrainingSource:
    name, path = about.pop("kind", "corpus"), about.pop("path", None)
    able = [kind for kind in kinds.entries() if kind.train is not None]
    if name != "auto":
        kind = kinds.named(name, f"{where}.kind", able)
    if path is None or not str(path):
        raise ValueError(
            f"{where}.path: got none, wanted a file or a folder, as in --config.{where}.path=PATH"
        )
    if name == "auto":
        layout = recognize(path)
        if layout.kind not in able:
            raise ValueError(
                f"{where}: {layout}, which cannot be trained on; wanted one of the kinds "
                f"{', '.join(kind.name for kind in able)}"
            )
        kind = layout.kind
    assert kind.train is not None  # as for all kinds in `able`
    needed, allowed = settings_of(kind.train)
    if set(about) - allowed or needed - set(about):
        raise ValueError(
            f"{where}: {kind.name} got {sorted(about)}, wanted path and, optionally, "
            f"{', '.join(sorted(allowed)) or 'repeat'}"
        )
    return kind.train(path, cache, **about)
