"""The record that describes one kind of data to the rest of the package."""

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
    """Names of pairs, and how to read each one. No cloud has been read yet."""

    names: Sequence[tuple[str, str]]
    """Source and target of each pair."""
    pairs: Sequence[Any]
    """The same pairs as input for `align_many`: two files, or a function that reads two clouds."""
    how: str
    """What was paired with what, in words."""


@dataclass(frozen=True)
class DataKind:
    """One kind of data: how it is recognized, and what can be done with it.

    A function that is None means that the data cannot be used that way. `train` and `evaluate` get
    a path and a folder `cache`, where they may keep results that take long to compute. Their
    keyword-only parameters are the settings that a config may give; those without a default are
    required. They raise ValueError, naming the path or the setting, if the data cannot be used.
    """

    name: str
    """The name in configs and for `--layout`."""
    words: str
    """A description for help texts and messages; begins with an article."""
    recognize: Callable[[Path], str | None]
    """Says in words what was found at a path; None if it is not of this kind.

    Looks at names and first bytes only, so that it is fast.
    """
    unlikely: Callable[[Path], bool] | None = None
    """Whether data that `recognize` accepts is more likely of another kind. If so, it is taken as
    this kind only if the user says so."""
    train: Callable[..., TrainingSource] | None = None
    """`train(path, cache, *, settings)`: a source of training pairs. The easiest way to make one is
    `data.scenes.scene_source`."""
    evaluate: Callable[..., Sequence[Pair]] | None = None
    """`evaluate(path, cache, *, settings)`: the pairs to evaluate, each with its true transform, as
    a list or as `runtime.sequences.OnDemand`."""
    example: str = ""
    """The file in configs/ that evaluates such data, with all settings."""
    list_pairs: Callable[[Path], Listing] | None = None
    """For `cfr batch`: the pairs, if the data itself defines them."""
    list_scans: Callable[[Path], list[Path]] | None = None
    """For `cfr batch`: files with one cloud each, in order, which `cfr batch` then pairs."""
    read_shapes: Callable[[Path], Corpus] | None = None
    """For `cfr data info`: the shapes."""

    def __post_init__(self) -> None:
        if not callable(self.recognize):
            raise ValueError(
                f"recognize: {self.name} got {self.recognize!r}, wanted a function of a path"
            )


def settings_of(opener: Callable[..., Any]) -> tuple[set[str], set[str]]:
    """The settings that `train` or `evaluate` requires, and all that it accepts.

    Settings are its keyword-only parameters.
    """
    given = [
        parameter
        for parameter in inspect.signature(opener).parameters.values()
        if parameter.kind is parameter.KEYWORD_ONLY
    ]
    needed = {parameter.name for parameter in given if parameter.default is parameter.empty}
    return needed, {parameter.name for parameter in given}
