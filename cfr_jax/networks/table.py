"""The table of networks: where everything that needs one looks it up.

A new network is a file of its own and a line in `_BUILT_IN`. One from outside the package is
registered by a call:

    from cfr_jax.networks.table import register_network

    register_network(my_network)   # a `record.Network`, before its name is used; a config is Python

Nothing here imports JAX: the record of a network is loaded once somebody asks for it.
"""

from __future__ import annotations

import importlib
from collections.abc import Collection
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cfr_jax.networks.record import Network

# By name, the module whose `NETWORK` is the record.
_BUILT_IN = {
    "cfr": "cfr_jax.networks.cfr.network",
    "rpmnet": "cfr_jax.networks.rpmnet",
}
_registered: dict[str, Network] = {}


def names() -> tuple[str, ...]:
    """All networks there are, those registered from outside last."""
    return (*_BUILT_IN, *_registered)


def network(name: str) -> Network:
    """The record of a network; raises ValueError, naming those that there are, for another name."""
    if name in _registered:
        return _registered[name]
    if name not in _BUILT_IN:
        known = ", ".join(map(repr, names()))
        raise ValueError(f"network: got {name!r}, wanted one of {known}")
    return importlib.import_module(_BUILT_IN[name]).NETWORK


def register_network(record: Network) -> None:
    """Adds a network from outside the package, for this process.

    The same record may be registered again. Raises ValueError for a name that is taken.
    """
    if record.name in _BUILT_IN or _registered.get(record.name, record) != record:
        raise ValueError(f"network: the name {record.name!r} is taken by another network")
    _registered[record.name] = record


def have(record: Network) -> None:
    """Registers a network that came from another process, unless it is there already."""
    if record.name not in _BUILT_IN:
        register_network(record)


def recognize(tensors: Collection[str]) -> Network:
    """The network that a file with tensors of these names holds; raises ValueError for none."""
    for record in map(network, names()):
        if record.recognizes(tensors):
            return record
    titles = ", ".join(record.title for record in map(network, names()))
    some = ", ".join(sorted(tensors)[:3]) or "none"
    raise ValueError(f"no network that is known ({titles}) has these tensors: {some}")
