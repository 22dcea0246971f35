"""What is trained: a network by name, and the curriculum it goes through."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax

from cfr_jax.networks import inputs, rpmnet
from cfr_jax.networks.cfr import iterations
from cfr_jax.networks.cfr import modules as network
from cfr_jax.training.config import Phase, TrainingConfig
from cfr_jax.training.step import Unroll

AnySettings = inputs.Settings | rpmnet.RPMNetSettings


@dataclasses.dataclass(frozen=True)
class Learner:
    """A network that can be trained, and how it is run in training and when it is validated."""

    fresh: Callable[[jax.Array], dict]
    unroll: Unroll
    trained: Callable[[int], AnySettings]
    """Settings by the number of neighbors."""
    validated: AnySettings


def learner(config: TrainingConfig) -> Learner:
    """The network that `config.network` names: "cfr", or "rpmnet" to compare with.

    Raises ValueError for another, and for `config.settings` that it does not have.
    """
    if config.network == "cfr":
        changed = config.settings
        _check_settings(changed)
        of_training = {"detach_motion": True, **changed}
        if config.train.precision == "bfloat16":
            of_training["activations"] = "bfloat16"
        return Learner(
            fresh=lambda key: network.init_params(key, config.iterations, config.shared),
            unroll=iterations.unroll,
            trained=lambda count: inputs.Settings(neighbors=count, **of_training),
            validated=inputs.Settings(**changed),
        )
    if config.network == "rpmnet":
        if changed := config.settings:
            raise ValueError(f"settings: got {', '.join(changed)}, wanted none for rpmnet")
        if config.train.precision == "bfloat16":
            raise ValueError("precision: got 'bfloat16', which rpmnet does not have")
        return Learner(
            fresh=rpmnet.init_params,
            unroll=rpmnet.unroll,
            trained=lambda count: rpmnet.RPMNetSettings(
                neighbors=count, iterations=config.iterations
            ),
            validated=rpmnet.RPMNetSettings(),
        )
    raise ValueError(f"network: got {config.network!r}, wanted 'cfr' or 'rpmnet'")


def _check_settings(changed: dict[str, Any]) -> None:
    allowed = {field.name for field in dataclasses.fields(inputs.Settings)}
    # those of the phases, of all training, and of its precision
    allowed -= {"neighbors", "detach_motion", "activations"}
    if unknown := changed.keys() - allowed:
        raise ValueError(
            f"settings: got {', '.join(sorted(unknown))}, wanted some of "
            f"{', '.join(sorted(allowed))}"
        )


def remaining(phases: Sequence[Phase], step: int) -> Iterator[tuple[Phase, int]]:
    """The phases that `step` has not finished, each with the number of its steps already done."""
    for phase in phases:
        if step < phase.steps:
            yield phase, step
        step = max(0, step - phase.steps)
