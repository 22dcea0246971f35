"""The network that is trained, looked up by name, and the phases of its curriculum."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax

from cfr_jax.networks import table
from cfr_jax.networks.record import Network, Objective, Unroll
from cfr_jax.training.config import Phase, TrainingConfig


@dataclasses.dataclass(frozen=True)
class Learner:
    """A network that can be trained, with its settings for training and for validation."""

    fresh: Callable[[jax.Array], dict]
    unroll: Unroll
    trained: Callable[[int], Any]
    """From the number of neighbors to the settings for training."""
    validated: Any
    objective: Objective | None
    """What is minimized instead of `losses.pair_loss`."""


def learner(config: TrainingConfig) -> Learner:
    """The network in the table that `config.network` names.

    Raises ValueError for an unknown name, and for `config.settings` that the network does not have.
    """
    record, changed = table.named(config.network), config.settings
    _check_settings(record, changed)
    of_training = dict(changed)
    if config.train.precision == "bfloat16":
        if "activations" not in _fields(record):
            raise ValueError(f"precision: got 'bfloat16', which {record.name} does not support")
        of_training["activations"] = "bfloat16"
    variant = {name: getattr(config, name) for name in record.variants}
    return Learner(
        fresh=functools.partial(record.fresh, iterations=config.iterations, **variant),
        unroll=record.unroll,
        trained=lambda count: dataclasses.replace(
            record.trained(count, config.iterations), **of_training
        ),
        validated=dataclasses.replace(record.validated, **changed),
        objective=record.objective,
    )


def _fields(record: Network) -> set[str]:
    return {field.name for field in dataclasses.fields(record.settings)}


def _check_settings(record: Network, changed: dict[str, Any]) -> None:
    if unknown := changed.keys() - set(record.changeable):
        wanted = f"some of {', '.join(sorted(record.changeable))}" if record.changeable else "none"
        raise ValueError(
            f"settings: got {', '.join(sorted(unknown))}, wanted {wanted} for {record.name}"
        )


def remaining(phases: Sequence[Phase], step: int) -> Iterator[tuple[Phase, int]]:
    """Yields the phases that are not finished at `step`, each with how many steps it has done."""
    for phase in phases:
        if step < phase.steps:
            yield phase, step
        step = max(0, step - phase.steps)
