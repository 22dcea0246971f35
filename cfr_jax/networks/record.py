"""What the rest of the package has to know of a network: its record in the table.

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

# Each network has a type of settings of its own, so to this table they are any.
Unroll = Callable[[Params, Cloud, Cloud, Any], Iterable[Step]]
"""The iterations of a network: parameters, source, target and settings in, one `Step` each out."""


class Part(NamedTuple):
    """A function that the registration of a pair calls so many times, to be timed alone."""

    module: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    times: int = 1


class Place(NamedTuple):
    """Where a tensor of the authors' checkpoint goes."""

    path: str
    """Of the parameter here, its names joined by "/"."""
    stacked: bool = False
    """Whether it is one of several that are stacked on a leading axis, in the order given."""


def places_of(
    layers: Iterable[tuple[str, str, str | None]], stacked: bool = False
) -> dict[str, Place]:
    """The places of layers, each told by its name in the checkpoint and by what its weight and its
    bias (None: it has none) are called here."""
    places = {}
    for theirs, weight, bias in layers:
        places[f"{theirs}.weight"] = Place(weight, stacked)
        if bias is not None:
            places[f"{theirs}.bias"] = Place(bias, stacked)
    return places


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """The checkpoints that a network's authors publish, told by the names of their tensors."""

    recognizes: Callable[[Collection[str]], bool]
    """Whether tensors of these names are such a checkpoint."""
    arguments: Callable[[Collection[str]], dict[str, Any]]
    """What `Network.fresh` is called with for parameters of that kind."""
    places: Callable[[Collection[str]], dict[str, Place]]
    """Where each tensor goes that there should be."""


@dataclasses.dataclass(frozen=True)
class Network:
    """A network, and how it is recognized, made, run, trained and timed.

    A method runs in a process of its own, which finds these functions by their names: they belong
    to a module, and lambdas do not do. A network that takes some sizes of clouds only raises
    ValueError from `unroll`, where sizes are known while it is traced. What must run on the host
    goes through `jax.pure_callback` there. Running means and other values that no gradient changes
    stand in the parameters all the same, and `unroll` stops gradients at them.
    """

    name: str
    """As a config calls it: `config.network`, or `use` of a method."""
    title: str
    """As people call it."""
    settings: type
    """Frozen dataclass of what changes the compiled program. Its `neighbors` and `radius` say how
    clouds are prepared. One that has a field `activations` can be trained in "bfloat16"."""
    fresh: Callable[..., Params]
    """`fresh(key, iterations=..., **variant)`: new parameters, a pytree of float32 arrays. What
    parameters do not depend on, it takes and ignores."""
    unroll: Unroll
    recognizes: Callable[[Collection[str]], bool]
    """Whether a file with tensors of these names holds this network."""
    arguments: Callable[[Mapping[str, tuple[int, ...]]], dict[str, Any]]
    """What `fresh` is called with for parameters of these shapes, by name."""
    trained: Callable[[int, int], Any]
    """Settings of a training, by the number of neighbors and of iterations."""
    validated: Any
    """Settings by which a training is validated."""
    iterations: Callable[[Params], int] | None = None
    """How many iterations parameters were made for; None where parameters do for any number."""
    variants: tuple[str, ...] = ()
    """Fields of a training's config, beside `iterations`, that `fresh` takes as well."""
    changeable: tuple[str, ...] = ()
    """Fields of the settings that `config.settings` of a training may change."""
    own_neighbors: bool = False
    """Whether it searches its neighbors itself, and needs those of a prepared cloud for nothing."""
    parts: Callable[[Params, Any], Callable[[Cloud, Cloud], Iterator[Part]]] | None = None
    """From parameters and settings: what makes the parts of a registration for timing."""
    checkpoint: Checkpoint | None = None
    """What `cfr convert` reads; None where nothing is published, or nothing is read of it."""
