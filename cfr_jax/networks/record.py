"""The record of a network in the table: all that the rest of the package knows about it.

A network is a file (or a folder) in `cfr_jax/networks` that ends in a `Network`, and one line in
`networks/table.py`. Everything else looks there: weights are recognized, trained, converted, timed
and compared by what the record says.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any, NamedTuple, TypeAlias

from jaxtyping import Array, Float

from cfr_jax.networks.inputs import Cloud
from cfr_jax.networks.sinkhorn import Affinity, Match


class Step(NamedTuple):
    """What one iteration found."""

    transform: Float[Array, "4 4"]
    """From the source as given onto the target."""
    match: Match
    affinity: Affinity


Params: TypeAlias = dict[str, Any]
"""The parameters of a network: a pytree of float32 arrays, named by the keys of nested dicts."""


class Motion(NamedTuple):
    """What one iteration found, for a network that `training.losses.pair_loss` does not train."""

    transform: Float[Array, "4 4"]
    """From the source as given onto the target."""


class Goal(NamedTuple):
    """What a network with its own loss makes of a training pair."""

    loss: Float[Array, ""]
    transforms: Float[Array, "L 4 4"]
    """What it found meanwhile, for the reports; from the source as given onto the target."""


# Each network has its own type of settings, so here it is `Any`.
Unroll = Callable[[Params, Cloud, Cloud, Any], Iterable[Step | Motion]]
"""The iterations of a network: from parameters, source, target and settings to one `Step` each, or
one `Motion` if the network has an objective."""
Objective = Callable[[Params, Cloud, Cloud, Float[Array, "4 4"], Any], Goal]
"""The loss of a network, from parameters, source, target, true motion and settings. It is called
inside a `vmap` over all or some pairs of a step, whose axis is `peers.batch_norm.PAIRS`."""


class Part(NamedTuple):
    """A function that the registration of a pair calls `times` times, to be timed alone."""

    module: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    times: int = 1


class Place(NamedTuple):
    """Where a tensor of the authors' checkpoint belongs."""

    path: str
    """The path of the parameter here, joined by "/"."""
    stacked: bool = False
    """Whether several tensors are stacked along a leading axis, in the given order."""


def places_of(
    layers: Iterable[tuple[str, str, str | None]], stacked: bool = False
) -> dict[str, Place]:
    """The places of all tensors of some layers.

    Each layer is given as its name in the checkpoint, the path of its weight here, and the path of
    its bias here (None: it has no bias).
    """
    places = {}
    for theirs, weight, bias in layers:
        places[f"{theirs}.weight"] = Place(weight, stacked)
        if bias is not None:
            places[f"{theirs}.bias"] = Place(bias, stacked)
    return places


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """How to read the checkpoints of a network's authors, from the names of their tensors."""

    recognizes: Callable[[Collection[str]], bool]
    """Whether tensors with these names are such a checkpoint."""
    arguments: Callable[[Mapping[str, Any]], dict[str, Any]]
    """Arguments of `Network.fresh` that make parameters of the same kind, from the tensors by name.
    """
    places: Callable[[Mapping[str, Any]], dict[str, Place]]
    """The place of every tensor that the checkpoint must have."""
    passed_over: tuple[str, ...] = ()
    """Ends of the names of tensors that may be there and are not needed: counters, constants."""


@dataclasses.dataclass(frozen=True)
class Network:
    """A network, and how it is recognized, made, run, trained and timed.

    An evaluation runs each method in its own process, which finds these functions by name: they
    must be functions of a module; a lambda or an inner function raises ValueError. A network that
    accepts only some sizes of clouds raises ValueError from `unroll`, where sizes are known during
    tracing. What must run on the host goes through `jax.pure_callback` there. Running means and
    other values that no gradient changes are part of the parameters too; `unroll` stops the
    gradients at them.
    """

    name: str
    """The name in configs: `config.network`, or `use` of a method."""
    title: str
    """The name for people."""
    settings: type
    """A frozen dataclass of what changes the compiled program. Its `neighbors` and `radius` say how
    clouds are prepared. With a field `activations`, the network can be trained in "bfloat16"."""
    fresh: Callable[..., Params]
    """`fresh(key, iterations=..., **variant)`: new parameters, a pytree of float32 arrays. It
    accepts and ignores arguments that its parameters do not depend on."""
    unroll: Unroll
    recognizes: Callable[[Collection[str]], bool]
    """Whether a file with tensors of these names holds this network."""
    arguments: Callable[[Mapping[str, tuple[int, ...]]], dict[str, Any]]
    """From the shapes of parameters, by name, to the arguments of `fresh` that make such shapes."""
    trained: Callable[[int, int], Any]
    """From the number of neighbors and of iterations to the settings for training."""
    validated: Any
    """The settings for validation during training."""
    iterations: Callable[[Params], int] | None = None
    """The number of iterations that parameters were made for; None if they work with any number."""
    variants: tuple[str, ...] = ()
    """Fields of the training config, besides `iterations`, that `fresh` also takes."""
    changeable: tuple[str, ...] = ()
    """Fields of the settings that `config.settings` of a training may change."""
    own_neighbors: bool = False
    """Whether it searches its neighbors itself and ignores those of a prepared cloud."""
    parts: Callable[[Params, Any], Callable[[Cloud, Cloud], Iterator[Part]]] | None = None
    """From parameters and settings to a function that yields the parts of a registration."""
    objective: Objective | None = None
    """What a training minimizes; None for the loss of CFR, `training.losses.pair_loss`."""
    checkpoint: Checkpoint | None = None
    """How `cfr convert` reads published checkpoints; None if it reads none."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            given = getattr(self, field.name)
            inner = getattr(given, "__qualname__", "")
            if "<lambda>" in inner or "<locals>" in inner:
                raise ValueError(
                    f"{field.name}: network {self.name} got {inner}, wanted a function of a "
                    "module, which other processes find by its name"
                )
