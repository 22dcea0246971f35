"""What the project has to know about one kind of data."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cfr_jax.data.corpus import Corpus
    from cfr_jax.data.pairs import Pair
    from cfr_jax.data.sources import TrainingSource


@dataclass(frozen=True)
class Listing:
    """Pairs by their names, and how to read each; no cloud is read yet."""

    names: Sequence[tuple[str, str]]
    """Source and target of each pair."""
    pairs: Sequence[Any]
    """The same pairs as `align_many` takes them: two files, or a function that reads two clouds."""
    how: str
    """In words, what was paired with what."""


@dataclass(frozen=True)
class DataKind:
    """One kind of data: how it is recognized, and what each room may do with it.

    A function that is None says that the data are not for that. Openers get a path and a folder
    `cache`, in which they may keep what took long to compute; their keyword-only parameters are the
    settings that a config may give, those without a default the ones that it has to give. They
    raise ValueError, naming the path or the setting, where the data cannot be used.
    """

    name: str
    """What configs and `--layout` call it."""
    words: str
    """What it is, for help texts and messages; begins with an article."""
    recognize: Callable[[Path], str | None]
    """What was found at a path, in words, or None if it is not of this kind.

    Looks at names and first bytes only, so that it takes no time.
    """
    unlikely: Callable[[Path], bool] | None = None
    """Whether data that fit are more likely of another kind; then they are of this one only if a
    user says so."""
    train: Callable[..., TrainingSource] | None = None
    """`train(path, cache, *, settings)`: what training pairs are drawn from; the easiest way to one
    is `data.scenes.scene_source`."""
    evaluate: Callable[..., Sequence[Pair]] | None = None
    """`evaluate(path, cache, *, settings)`: the pairs to measure on, each with its true transform;
    a list, or `data.pairs.PairsOnDemand`."""
    example: str = ""
    """The file in configs/ that evaluates such data, with all settings."""
    list_pairs: Callable[[Path], Listing] | None = None
    """For `cfr batch`: the pairs, where the data say themselves which these are."""
    list_scans: Callable[[Path], list[Path]] | None = None
    """For `cfr batch`: files of a cloud each, in order, which it pairs."""
    read_shapes: Callable[[Path], Corpus] | None = None
    """For `cfr data info`."""


def settings_of(opener: Callable[..., Any]) -> tuple[set[str], set[str]]:
    """The settings that an opener needs, and all that it takes: its keyword-only parameters."""
    given = [
        parameter
        for parameter in inspect.signature(opener).parameters.values()
        if parameter.kind is parameter.KEYWORD_ONLY
    ]
    needed = {parameter.name for parameter in given if parameter.default is parameter.empty}
    return needed, {parameter.name for parameter in given}
