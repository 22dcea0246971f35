"""Weights on disk: safetensors, one array per parameter, named by its path in the tree."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from pathlib import Path

import jax
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from cfr_jax.networks import rpmnet
from cfr_jax.networks.cfr import modules as cfr_network
from cfr_jax.runtime.atomic import write_atomically

SHIPPED = Path(__file__).parent / "shipped"
DEFAULT = "object"
NETWORKS = {"cfr": "CFR", "rpmnet": "RPM-Net"}


class NoWeights(ValueError):
    """There is no such file, and nothing that ships has that name."""


@dataclasses.dataclass(frozen=True)
class Weights:
    """Parameters and where they come from."""

    params: dict
    name: str
    network: str
    """One of `NETWORKS`; read off the names of the tensors."""
    sha256: str
    """Over the tensors and the notes, as written into the file when it was made."""
    notes: dict[str, str]


def save_params(path: str | Path, params: dict, notes: dict[str, str] | None = None) -> None:
    """Writes parameters and notes about them (strings), beside first and then renamed.

    Raises OSError, naming the file, where it cannot be written.
    """
    path, notes = Path(path), dict(notes or {})
    tensors = {name: np.asarray(leaf) for name, leaf in flatten_dict(params, sep="/").items()}
    try:
        # as bytes: a file that safetensors writes is closed to everyone but its owner
        write_atomically(path, save(tensors, metadata=notes | {"sha256": _digest(tensors, notes)}))
    except OSError as error:
        raise OSError(f"weights: {path} could not be written ({error})") from error


def load_params(source: str | Path = DEFAULT, network: str = "cfr") -> dict:
    """Parameters that ship with the package, by name, or of a .safetensors file, by path.

    A pytree of float32 arrays for `register`, or for `rpmnet.unroll` with `network="rpmnet"`.
    Raises ValueError as `read_weights` does.
    """
    return read_weights(source, network).params


def shipped() -> tuple[str, ...]:
    """Names of the weights in the package."""
    return tuple(sorted(path.stem for path in SHIPPED.glob("*.safetensors")))


def network_of(params: dict) -> str:
    """Which of `NETWORKS` these parameters are made for, by their names."""
    return _network_of(flatten_dict(params, sep="/"))


def read_weights(source: str | Path = DEFAULT, network: str | None = None) -> Weights:
    """Weights with their network, name, digest and notes.

    Raises `NoWeights` where there is no such name or file, and ValueError where the file is not
    sound (its digest does not fit) or holds another network than `network` (None: takes either).
    """
    path = Path(source)
    if str(source) in shipped():
        path = SHIPPED / f"{source}.safetensors"
    if not path.is_file():
        raise NoWeights(
            f"weights: no file and no shipped weights called {str(source)!r}; "
            f"shipped are {', '.join(shipped()) or 'none'}"
        )
    try:
        with safe_open(path, framework="numpy") as file:
            notes = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, OSError, ValueError, TypeError, KeyError) as error:
        raise ValueError(f"weights: {path} is no readable safetensors file ({error})") from error
    told = notes.pop("sha256", None)
    if told is None:
        raise ValueError(
            f"weights: {path} carries no digest, so it was not written by cfr_jax; "
            "the authors' own tensors go through `cfr convert` first"
        )
    if told != _digest(tensors, notes):
        raise ValueError(f"weights: {path} is damaged: its digest does not fit its content")
    kind = _network_of(tensors)
    if path.parent != SHIPPED:  # those are checked by the tests: tracing a network takes a second
        _check_shapes(path, tensors, kind)
    if network not in (None, kind):
        raise ValueError(
            f"weights: {path} holds the network {NETWORKS[kind]}, wanted {NETWORKS[network]}"
        )
    # not jnp.asarray, which compiles a copy of each shape
    params = jax.device_put(unflatten_dict(tensors, sep="/"))
    return Weights(params, path.stem, kind, told, notes)


def _network_of(tensors):
    return "rpmnet" if any(n.startswith("features/neighbor_") for n in tensors) else "cfr"


def _check_shapes(path, tensors, kind):
    fresh = rpmnet.init_params
    if kind == "cfr":
        stacked = tensors.get("cascade/kernel", np.zeros(0))
        annealing = tensors.get("annealing/out/bias", np.zeros(10))
        fresh = functools.partial(
            cfr_network.init_params,
            iterations=max(1, annealing.size // 2),
            shared=stacked.shape[:1] == (1,),
        )
    wanted = jax.eval_shape(lambda: fresh(jax.random.key(0)))
    wanted = {name: leaf.shape for name, leaf in flatten_dict(wanted, sep="/").items()}
    found = {name: leaf.shape for name, leaf in tensors.items()}
    for name in sorted(wanted.keys() | found.keys()):
        if wanted.get(name) != found.get(name):
            raise ValueError(
                f"weights: {path} does not hold {NETWORKS[kind]}: {name} is "
                f"{found.get(name, 'missing')}, wanted {wanted.get(name, 'no such tensor')}"
            )
        if tensors[name].dtype != np.float32:
            raise ValueError(f"weights: {path}: {name} is {tensors[name].dtype}, wanted float32")


def _digest(tensors, notes):
    digest = hashlib.sha256(json.dumps(notes, sort_keys=True).encode())
    for name in sorted(tensors):
        array = np.ascontiguousarray(tensors[name])
        digest.update(f"{name}{array.shape}{array.dtype}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
