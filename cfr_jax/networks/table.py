"""The table of networks, where all other code looks them up.

A new network is a file of its own and a line in `_BUILT_IN`. To add one from outside the package,
for example in a config file, call:

    from cfr_jax.networks import table

    table.add(my_network)   # a `record.Network`, before its name is used

Nothing here imports JAX: the record of a network is loaded when it is first asked for.
"""

from __future__ import annotations

import importlib
from collections.abc import Collection
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cfr_jax.networks.record import Network

# From the name of a network to the module with its record, `NETWORK`.
_BUILT_IN = {
    "cfr": "cfr_jax.networks.cfr.network",
    "rpmnet": "cfr_jax.networks.rpmnet",
    "dcp": "cfr_jax.networks.peers.dcp",
    "fmr": "cfr_jax.networks.peers.fmr",
    "rgm": "cfr_jax.networks.peers.rgm",
}
_registered: dict[str, Network] = {}


def names() -> tuple[str, ...]:
    """The names of all networks; those registered from outside come last."""
    return (*_BUILT_IN, *_registered)


def named(name: str) -> Network:
    """The record of a network; raises a ValueError that lists all names for an unknown one."""
    if name in _registered:
        return _registered[name]
    if name not in _BUILT_IN:
        known = ", ".join(map(repr, names()))
        raise ValueError(f"network: got {name!r}, wanted one of {known}")
    return importlib.import_module(_BUILT_IN[name]).NETWORK


def add(record: Network) -> None:
    """Adds a network from outside the package, for this process.

    The same record may be registered again. Raises ValueError if another network has its name.
    """
    from cfr_jax.networks.record import Network

    if not isinstance(record, Network):
        raise ValueError(f"record: got {record!r}, wanted a Network")
    if record.name in _BUILT_IN or _registered.get(record.name, record) != record:
        raise ValueError(f"network: the name {record.name!r} is taken by another network")
    _registered[record.name] = record


def have(record: Network) -> None:
    """Registers a network that came from another process, unless it is known already."""
    if record.name not in _BUILT_IN:
        add(record)


def recognize(tensors: Collection[str]) -> Network:
    """The network whose weights have tensors of these names; raises ValueError if none does."""
    for record in map(named, names()):
        if record.recognizes(tensors):
            return record
    titles = ", ".join(record.title for record in map(named, names()))
    some = ", ".join(sorted(tensors)[:3]) or "none"
    raise ValueError(f"no known network ({titles}) has these tensors: {some}")
