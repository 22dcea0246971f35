"""Weights on disk: safetensors files with one array per parameter, named by its path in the
tree."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from safetensors.numpy import load, save

from cfr_jax.networks import table
from cfr_jax.networks.clues import NetworkClues
from cfr_jax.networks.probability import KEY, Calibration, calibration_of, uncalibrated
from cfr_jax.networks.record import Network, Params
from cfr_jax.runtime.atomic import write_atomically
from cfr_jax.runtime.entries import entry
from cfr_jax.runtime.messages import Refused, shown
from cfr_jax.runtime.reading import contents, parse_json

SHIPPED = Path(__file__).parent / "shipped"
DEFAULT = "object"

_LARGE = 4096  # numbers of a tensor that float16 files round
_LARGEST_FLOAT16 = float(np.finfo(np.float16).max)


class NoWeights(ValueError):
    """There is no such file, and no shipped weights have that name."""


@dataclasses.dataclass(frozen=True)
class Weights:
    """Parameters and where they come from."""

    params: Params
    """Includes the calibration, if the file has one (`networks.probability`)."""
    name: str
    network: str
    """The network's name in the table of networks, recognized from the names of the tensors."""
    sha256: str
    """Digest of the tensors and the notes, as written into the file when it was made."""
    notes: dict[str, str]
    """All other notes in the file."""


def save_params(
    path: str | Path,
    params: Params,
    notes: dict[str, str] | None = None,
    *,
    float16: bool = False,
) -> None:
    """Writes parameters and notes about them (strings) to a temporary file, then renames it.

    With `float16`, the file is half as large: tensors of 4,096 numbers and more are rounded to
    float16 (by at most 2^-11 of a number, or 2^-25 near zero), and `read_weights` gives them back
    in float32. Smaller ones, such as norms and biases, stay as they are.

    The calibration of the parameters, if they have one, is also written as a note. Raises OSError,
    naming the file, if it cannot be written, and ValueError for a note under a reserved name or,
    with `float16`, for a tensor with a number beyond 65,504.
    """
    path, notes = Path(path), dict(notes or {})
    for name in notes.keys() & {KEY, "sha256"}:
        raise ValueError(f"notes: got the reserved name {name!r}, wanted another name")
    if (calibration := calibration_of(params)) is not None:
        notes[KEY] = calibration.write()
    tensors = {name: np.asarray(leaf) for name, leaf in _flat(params).items()}
    if float16:
        tensors = {name: _rounded(name, tensor) for name, tensor in tensors.items()}
    try:
        # as bytes, because a file that safetensors writes is readable only by its owner
        write_atomically(path, save(tensors, metadata=notes | {"sha256": _digest(tensors, notes)}))
    except OSError as error:
        raise OSError(f"weights: {path} could not be written ({error})") from error


@entry
def load_params(source: str | Path = DEFAULT, network: str = "cfr") -> Params:
    """Parameters that ship with the package, by name, or from a .safetensors file, by path.

    They are a pytree of float32 arrays for `register`, or for the `unroll` of another `network` in
    the table. `params["calibration"]` has the coefficients of the confidence. Weights that were not
    calibrated (`cfr calibrate`) lack it and give no confidence. It has no leaves, so gradients and
    optimizers ignore it. Raises ValueError as `read_weights` does.
    """
    return read_weights(source, network).params


def shipped() -> tuple[str, ...]:
    """Names of the weights that ship with the package."""
    return tuple(sorted(path.stem for path in SHIPPED.glob("*.safetensors")))


def is_ours(path: str | Path) -> bool:
    """Whether a file has the digest that `save_params` writes; whether it fits is not checked."""
    if Path(path).suffix != ".safetensors":
        return False
    try:
        return "sha256" in _metadata(contents(path))
    except (ValueError, AttributeError, TypeError):  # no file, or no header of such a form
        return False


def network_of(params: Params) -> str:
    """The name of the network that the parameters are made for, recognized from their names."""
    return table.recognize(_flat(params)).name


def read_weights(source: str | Path = DEFAULT, network: str | None = None) -> Weights:
    """Reads weights with their network, name, digest and notes.

    Raises `NoWeights` if there is no such name or file. Raises ValueError if the file is damaged
    (its digest does not match, or its calibration is malformed), if a number in it is not finite,
    or if it holds a different network than `network` (None: any).
    """
    path = Path(source)
    if str(source) in shipped():
        path = SHIPPED / f"{source}.safetensors"
    if not os.path.exists(path):
        raise NoWeights(
            f"weights: there is no file and no shipped weights called {shown(source)!r}; "
            f"shipped are {', '.join(shipped()) or 'none'}"
        )
    where = f"weights: {shown(path)}"
    try:
        data = contents(path)
        # not by its name: what is read is what was opened
        tensors, notes = load(data), _metadata(data)
    except Exception as error:  # also of a type of numbers that numpy does not have
        raise Refused(f"{where} is not a readable safetensors file ({error})") from error
    told = notes.pop("sha256", None)
    if told is None:
        raise Refused(
            f"{where} has no digest, so cfr_jax did not write it; "
            "convert the authors' own tensors with `cfr convert` first"
        )
    if told != _digest(tensors, notes):
        raise Refused(f"{where} is damaged: its digest does not match its content")
    try:
        record = table.recognize(tensors)
        calibration = _calibration(notes.pop(KEY, None))
        if path.parent != SHIPPED:  # tests check those, because tracing a network takes a second
            _check_shapes(tensors, record)
        for name, value in tensors.items():
            if not np.isfinite(value).all():
                raise ValueError(f"{name} holds a number that is not finite")
    except ValueError as error:
        raise Refused(f"{where}: {error}") from error
    if network not in (None, record.name):
        wanted = table.named(network).title
        raise Refused(f"{where} holds the network {record.title}, wanted {wanted}")
    wide = {
        name: value.astype(np.float32) if value.dtype == np.float16 else value
        for name, value in tensors.items()
    }
    # not jnp.asarray, which compiles a copy for each shape
    params = jax.device_put(unflatten_dict(wide, sep="/"))
    if calibration is not None:
        params[KEY] = calibration
    return Weights(params, path.stem, record.name, told, notes)


def _rounded(name: str, tensor: np.ndarray) -> np.ndarray:
    """The tensor in float16 if it is large, otherwise itself."""
    if tensor.dtype != np.float32 or tensor.size < _LARGE:
        return tensor
    largest = np.abs(tensor).max()
    if largest > _LARGEST_FLOAT16:
        raise ValueError(
            f"float16: {name} holds {largest:g}, wanted at most {_LARGEST_FLOAT16:g}; "
            "save these weights in float32"
        )
    return tensor.astype(np.float16)


def _calibration(note: str | None) -> Calibration | None:
    if note is None:
        return None
    calibration = Calibration.read(note)
    # the clues of `align` are checked where they are known
    calibration.check("register", [field.name for field in dataclasses.fields(NetworkClues)])
    return calibration


def _flat(params: Mapping[str, Any]) -> dict[str, Any]:
    return flatten_dict(uncalibrated(params), sep="/")


def _check_shapes(tensors: dict[str, np.ndarray], record: Network) -> None:
    found = {name: leaf.shape for name, leaf in tensors.items()}
    # `arguments` refuses more iterations than can be traced
    wanted = _fresh_shapes(record, tuple(record.arguments(found).items()))
    for name in sorted(wanted.keys() | found.keys()):
        if wanted.get(name) != found.get(name):
            raise ValueError(
                f"it does not hold {record.title}: {shown(name)} is "
                f"{found.get(name, 'missing')}, wanted {wanted.get(name, 'no such tensor')}"
            )
        if tensors[name].dtype not in (np.float32, np.float16):
            raise ValueError(f"{name} is {tensors[name].dtype}, wanted float32 or float16")


@functools.lru_cache(maxsize=16)
def _fresh_shapes(
    record: Network, arguments: tuple[tuple[str, Any], ...]
) -> Mapping[str, tuple[int, ...]]:
    fresh = jax.eval_shape(functools.partial(record.fresh, **dict(arguments)), jax.random.key(0))
    return {name: leaf.shape for name, leaf in flatten_dict(fresh, sep="/").items()}


def _metadata(data: bytes) -> dict[str, str]:
    """The notes in the header of a safetensors file that the library has read."""
    length = int.from_bytes(data[:8], "little")
    return parse_json(data[8 : 8 + length]).get("__metadata__") or {}


def _digest(tensors: Mapping[str, np.ndarray], notes: Mapping[str, Any]) -> str:
    digest = hashlib.sha256(json.dumps(notes, sort_keys=True).encode())
    for name in sorted(tensors):
        array = np.ascontiguousarray(tensors[name])
        digest.update(f"{name}{array.shape}{array.dtype}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
