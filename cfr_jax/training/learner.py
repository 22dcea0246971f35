"""What is trained: a network by name, and the curriculum it goes through."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax

from cfr_jax.networks import table
from cfr_jax.networks.record import Network, Unroll
from cfr_jax.training.config import Phase, TrainingConfig


@dataclasses.dataclass(frozen=True)
class Learner:
    """A network that can be trained, and how it is run in training and when it is validated."""

    fresh: Callable[[jax.Array], dict]
    unroll: Unroll
    trained: Callable[[int], Any]
    """Settings by the number of neighbors."""
    validated: Any


def learner(config: TrainingConfig) -> Learner:
    """The network of the table that `config.network` names.

    Raises ValueError for another, and for `config.settings` that it does not have.
    """
    record, changed = table.network(config.network), config.settings
    _check_settings(record, changed)
    of_training = dict(changed)
    if config.train.precision == "bfloat16":
        if "activations" not in _fields(record):
            raise ValueError(f"precision: got 'bfloat16', which {record.name} does not have")
        of_training["activations"] = "bfloat16"
    variant = {name: getattr(config, name) for name in record.variants}
    return Learner(
        fresh=functools.partial(record.fresh, iterations=config.iterations, **variant),
        unroll=record.unroll,
        trained=lambda count: dataclasses.replace(
            record.trained(count, config.iterations), **of_training
        ),
        validated=dataclasses.replace(record.validated, **changed),
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
    """The phases that `step` has not finished, each with the number of its steps already done."""
    for phase in phases:
        if step < phase.steps:
            yield phase, step
        step = max(0, step - phase.steps)
