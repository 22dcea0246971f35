"""Converts published PyTorch checkpoints of networks to parameters of this package.

The record of each network (`networks.record.Checkpoint`) says which tensor goes where.

A checkpoint's tensors are named by their place in PyTorch's modules. The weight of a 1x1
convolution is that of a Linear layer, (out, in), with one or two extra axes of length 1. Our
kernels are (in, out).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from safetensors.numpy import load_file

from cfr_jax.networks import table
from cfr_jax.networks.record import Checkpoint, Network, Params


def convert(path: str | Path) -> Params:
    """Parameters from a checkpoint by a network's authors: CFR, RPM-Net, DCP, FMR or RGM.

    The names of the tensors decide which network it is; `weights.files.network_of` tells it from
    the result. `path` is a PyTorch file (.pth, .pt or .t7; needs torch, which reads only tensors
    and unpickles no objects), or a .safetensors or .npz file with the same tensors under the same
    names. For CFR, all iterations in the file are kept. Raises ValueError, naming every tensor that
    is missing, unknown, of the wrong shape, or not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"path: there is no checkpoint at {path}")
    readers: dict[str, Callable[[Path], dict[str, np.ndarray]]] = {
        ".pth": _read_torch,
        ".pt": _read_torch,
        ".t7": _read_torch,
        ".safetensors": lambda path: load_file(path),
        ".npz": _read_npz,
    }
    if path.suffix not in readers:
        raise ValueError(f"path: got a checkpoint {path.name}, wanted one of {', '.join(readers)}")
    try:
        state = readers[path.suffix](path)
    except ImportError as error:
        raise ValueError(
            f'path: {path.name} is a PyTorch file: pip install "cfr_jax[torch]" to read it'
        ) from error
    except Exception as error:  # a damaged archive may raise anything
        raise ValueError(f"path: {path} is not a readable checkpoint ({error})") from error
    return from_state_dict(state, str(path))


def from_state_dict(state: dict[str, np.ndarray], name: str = "state_dict") -> Params:
    """`convert` for arrays that are already in memory. `name` is used in error messages."""
    record, checkpoint = _recognized(state, name)
    places = checkpoint.places(state)
    fresh = functools.partial(record.fresh, **checkpoint.arguments(state))
    ours = jax.eval_shape(fresh, jax.random.key(0))
    shapes = {key: leaf.shape for key, leaf in flatten_dict(ours, sep="/").items()}
    faults = [f"{theirs} is missing" for theirs in places if theirs not in state]
    faults += [
        f"{theirs} is unknown"
        for theirs in state
        if theirs not in places and not theirs.endswith(checkpoint.passed_over)
    ]
    found: dict[str, list[np.ndarray]] = {}
    for theirs, place in places.items():
        if theirs not in state:
            continue
        value, shape = state[theirs], shapes[place.path][1 if place.stacked else 0 :]
        if _squeezed(value.shape, len(shape)) != shape[::-1]:
            faults.append(f"{theirs} has shape {value.shape}, wanted {shape[::-1]}")
            continue
        if not np.issubdtype(value.dtype, np.floating):
            faults.append(f"{theirs} holds {value.dtype}, wanted floats")
            continue
        with np.errstate(over="ignore"):
            value = value.reshape(shape[::-1]).T.astype(np.float32)
        if not np.isfinite(value).all():
            faults.append(f"{theirs} is not finite in float32")
        found.setdefault(place.path, []).append(value)
    if faults:
        raise ValueError(f"{name} does not hold {record.title}: {'; '.join(faults)}")
    stacked = {place.path for place in places.values() if place.stacked}
    joined = {path: np.stack(v) if path in stacked else v[0] for path, v in found.items()}
    return unflatten_dict({path: jnp.asarray(value) for path, value in joined.items()}, sep="/")


def _recognized(names: Collection[str], where: str) -> tuple[Network, Checkpoint]:
    """The network whose authors' checkpoints have tensors with these names."""
    titles = []
    for record in map(table.network, table.names()):
        if record.checkpoint is None:
            continue
        if record.checkpoint.recognizes(names):
            return record, record.checkpoint
        titles.append(record.title)
    raise ValueError(
        f"{where} does not hold {' or '.join(titles)}: the names of its tensors match none of them"
    )


def _squeezed(shape: tuple[int, ...], axes: int) -> tuple[int, ...]:
    """The shape without the extra last axes of a 1x1 convolution."""
    beyond = shape[axes:] if axes == 2 else ()
    return shape[:axes] if len(beyond) <= 2 and set(beyond) <= {1} else shape


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
        return dict(arrays)


def _read_torch(path: Path) -> dict[str, np.ndarray]:
    import torch

    content = torch.load(path, map_location="cpu", weights_only=True)
    state = content.get("state_dict", content)
    return {name: value.to(torch.float32).numpy() for name, value in state.items()}
