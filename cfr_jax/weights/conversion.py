"""Converts published PyTorch checkpoints of networks to parameters of this package.

The record of each network (`networks.record.Checkpoint`) says which tensor goes where.

A checkpoint's tensors are named by their place in PyTorch's modules. The weight of a 1x1
convolution is that of a Linear layer, (out, in), with one or two extra axes of length 1. Our
kernels are (in, out).
"""

from __future__ import annotations

import functools
import os
import zipfile
from collections.abc import Callable, Collection
from io import BytesIO
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from safetensors.numpy import load

from cfr_jax.networks import table
from cfr_jax.networks.record import Checkpoint, Network, Params
from cfr_jax.runtime.messages import Refused, shown
from cfr_jax.runtime.reading import contents

# Bytes that tensors may take: so many, and for each byte of their file so many more.
_LEAST_BUDGET, _BUDGET = 64 << 20, 4
_MOST_OF_FAULTS = 400  # characters


def convert(path: str | Path) -> Params:
    """Parameters from a checkpoint by a network's authors: CFR, RPM-Net, DCP, FMR or RGM.

    The names of the tensors decide which network it is; `weights.files.network_of` tells it from
    the result. `path` is a PyTorch file (.pth, .pt or .t7; needs torch, which reads only tensors
    and unpickles no objects), or a .safetensors or .npz file with the same tensors under the same
    names. For CFR, all iterations in the file are kept. Raises ValueError, naming the tensors that
    are missing, unknown, of the wrong shape, or not finite (of many, the first), and for files that
    unfold to much more than their own size.
    """
    path = Path(path)
    readers: dict[str, Callable[[bytes], dict[str, Any]]] = {
        ".pth": _read_torch,
        ".pt": _read_torch,
        ".t7": _read_torch,
        ".safetensors": load,
        ".npz": _read_npz,
    }
    if not os.path.exists(path):
        raise Refused(f"path: there is no checkpoint at {shown(path)}")
    if path.suffix not in readers:
        raise Refused(f"path: got a checkpoint {path.name}, wanted one of {', '.join(readers)}")
    try:
        state = readers[path.suffix](contents(path))
    except ImportError as error:
        raise Refused(
            f'path: {shown(path)} is a PyTorch file: pip install "cfr_jax[torch]" to read it'
        ) from error
    except Exception as error:  # a damaged archive may raise anything
        raise Refused(f"path: {shown(path)} is not a readable checkpoint ({error})") from error
    return from_state_dict(state, shown(path))


def from_state_dict(state: dict[str, np.ndarray], name: str = "state_dict") -> Params:
    """`convert` for arrays that are already in memory. `name` is used in error messages."""
    for key, value in state.items():
        if not isinstance(key, str) or not isinstance(value, np.ndarray):
            raise Refused(
                f"{name}: {shown(repr(key))} is a {type(value).__name__}, "
                "wanted arrays under names that are text"
            )
    record, checkpoint = _recognized(state, name)
    try:
        places = checkpoint.places(state)
    except ValueError as error:
        raise Refused(f"{name} does not hold {record.title}: {error}") from error
    fresh = functools.partial(record.fresh, **checkpoint.arguments(state))
    ours = jax.eval_shape(fresh, jax.random.key(0))
    shapes = {key: leaf.shape for key, leaf in flatten_dict(ours, sep="/").items()}
    faults = [f"{theirs} is missing" for theirs in places if theirs not in state]
    faults += [
        f"{shown(theirs)} is unknown"
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
        raise Refused(f"{name} does not hold {record.title}: {_some(faults)}")
    stacked = {place.path for place in places.values() if place.stacked}
    joined = {path: np.stack(v) if path in stacked else v[0] for path, v in found.items()}
    return unflatten_dict({path: jnp.asarray(value) for path, value in joined.items()}, sep="/")


def _some(faults: list[str]) -> str:
    """As many as a message takes, and how many more there are."""
    told, length = 0, len(faults[0])
    while told + 1 < len(faults) and length < _MOST_OF_FAULTS:
        told += 1
        length += 2 + len(faults[told])
    left = len(faults) - told - 1
    return "; ".join([*faults[: told + 1], *([f"and {left} more"] if left else [])])


def _recognized(names: Collection[str], where: str) -> tuple[Network, Checkpoint]:
    """The network whose authors' checkpoints have tensors with these names."""
    titles = []
    for record in map(table.named, table.names()):
        if record.checkpoint is None:
            continue
        if record.checkpoint.recognizes(names):
            return record, record.checkpoint
        titles.append(record.title)
    raise Refused(
        f"{where} does not hold {' or '.join(titles)}: the names of its tensors match none of them"
    )


def _squeezed(shape: tuple[int, ...], axes: int) -> tuple[int, ...]:
    """The shape without the extra last axes of a 1x1 convolution."""
    beyond = shape[axes:] if axes == 2 else ()
    return shape[:axes] if len(beyond) <= 2 and set(beyond) <= {1} else shape


def _read_npz(data: bytes) -> dict[str, np.ndarray]:
    _check_archive(data)
    with np.load(BytesIO(data), allow_pickle=False) as arrays:
        return dict(arrays)


def _read_torch(data: bytes) -> dict[str, np.ndarray]:
    import torch

    if zipfile.is_zipfile(BytesIO(data)):  # the format before PyTorch 1.6 is none
        _check_archive(data)
    content = torch.load(BytesIO(data), map_location="cpu", weights_only=True)
    state = content.get("state_dict", content) if isinstance(content, dict) else content
    if not isinstance(state, dict):
        raise Refused(f"holds a {type(state).__name__}, wanted a dict of tensors")
    for name, value in state.items():
        if not isinstance(name, str):
            raise Refused(f"{shown(repr(name))} is the name of a tensor, wanted text")
        if not isinstance(value, torch.Tensor) or value.layout != torch.strided:
            raise Refused(f"{shown(repr(name))} is no tensor with a number in each place")
    # one number may stand for a large tensor
    _check_size(data, 4 * sum(value.numel() for value in state.values()))
    return {
        name: (value.to(torch.float32) if value.is_floating_point() else value).numpy()
        for name, value in state.items()
    }


def _check_archive(data: bytes) -> None:
    """Refuses an archive that unfolds to much more than itself, before it is unfolded."""
    with zipfile.ZipFile(BytesIO(data)) as archive:
        _check_size(data, sum(member.file_size for member in archive.infolist()))


def _check_size(data: bytes, size: int) -> None:
    most = _LEAST_BUDGET + _BUDGET * len(data)
    if size > most:
        raise Refused(f"holds {size:,} bytes of tensors, wanted at most {most:,} for its size")
