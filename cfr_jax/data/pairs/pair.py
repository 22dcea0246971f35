"""A pair of clouds, and what all files of pairs have in common."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from cfr_jax.runtime.messages import Refused, shown
from cfr_jax.runtime.sequences import MadeOnAccess


@dataclass(frozen=True, eq=False)
class Pair:
    """Two clouds and what is known about them; None means not known.

    `transform` is the true motion; it maps source onto target: `transform @ [x; 1]`. `overlap` is
    the share of the source that is also in the target. `clean_source` and `clean_target` are the
    whole shapes without noise or crop, each in the frame of its cloud. Units are those of the file.
    """

    name: str
    source: Float[np.ndarray, "n 3"]
    target: Float[np.ndarray, "m 3"]
    source_normals: Float[np.ndarray, "n 3"] | None = None
    target_normals: Float[np.ndarray, "m 3"] | None = None
    transform: Float[np.ndarray, "4 4"] | None = None
    overlap: float | None = None
    clean_source: Float[np.ndarray, "p 3"] | None = None
    clean_target: Float[np.ndarray, "p 3"] | None = None


def among(chosen: tuple[int, int] | None, frames: Iterable[int | str]) -> bool:
    """Whether all `frames` of a pair are numbers in the half-open range `chosen`.

    None chooses all pairs. A frame that is a name, not a number, is in no range.
    """
    return chosen is None or all(
        isinstance(frame, int) and chosen[0] <= frame < chosen[1] for frame in frames
    )


class PairFile(MadeOnAccess[Pair]):
    """The pairs of a file, in its order."""

    path: Path

    def __init__(self, path: str | Path):
        self.path = Path(path)
        if not os.path.exists(self.path):
            raise Refused(f"path: there is no file of pairs at {shown(path)}")

    @property
    def names(self) -> tuple[str, ...]:
        """What each pair is called; reads no cloud."""
        raise NotImplementedError


def with_truth(held: PairFile, index: int) -> Pair:
    """Pair `index`. Raises ValueError if its true transform is not known."""
    pair = held[index]
    if pair.transform is None:
        raise ValueError(f"{held.path}: {pair.name} has no true transform to learn from")
    return pair
