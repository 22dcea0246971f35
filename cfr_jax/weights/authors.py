"""The published PyTorch checkpoints of CFR and RPM-Net as parameters of this package.

A checkpoint's layers are named by their place in PyTorch's modules. A 1x1 convolution is a Linear
whose weight (out, in) carries one or two more axes of length 1; our kernels are (in, out).
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from safetensors.numpy import load_file

from cfr_jax.networks import rpmnet
from cfr_jax.networks.cfr import modules as network
from cfr_jax.weights.files import NETWORKS

Layers = tuple[tuple[str, str, str], ...]

_ANNEALING: Layers = (
    # theirs; what their weight is called here; their bias
    ("weights_net.prepool.0", "annealing/point_0_dense/kernel", "annealing/point_0_dense/bias"),
    ("weights_net.prepool.1", "annealing/point_0_scale", "annealing/point_0_shift"),
    ("weights_net.prepool.3", "annealing/point_1_dense/kernel", "annealing/point_1_dense/bias"),
    ("weights_net.prepool.4", "annealing/point_1_scale", "annealing/point_1_shift"),
    ("weights_net.prepool.6", "annealing/point_2_dense/kernel", "annealing/point_2_dense/bias"),
    ("weights_net.prepool.7", "annealing/point_2_scale", "annealing/point_2_shift"),
    ("weights_net.prepool.9", "annealing/point_3_dense/kernel", "annealing/point_3_dense/bias"),
    ("weights_net.prepool.10", "annealing/point_3_scale", "annealing/point_3_shift"),
    ("weights_net.prepool.12", "annealing/point_4_dense/kernel", "annealing/point_4_dense/bias"),
    ("weights_net.prepool.13", "annealing/point_4_scale", "annealing/point_4_shift"),
    ("weights_net.postpool.0", "annealing/pair_0_dense/kernel", "annealing/pair_0_dense/bias"),
    ("weights_net.postpool.1", "annealing/pair_0_scale", "annealing/pair_0_shift"),
    ("weights_net.postpool.3", "annealing/pair_1_dense/kernel", "annealing/pair_1_dense/bias"),
    ("weights_net.postpool.4", "annealing/pair_1_scale", "annealing/pair_1_shift"),
    ("weights_net.postpool.6", "annealing/out/kernel", "annealing/out/bias"),
)
_CFR: Layers = (
    *_ANNEALING,
    ("feat_extractor_ball.prepool.0", "features/kernel_0", "features/bias_0"),
    ("feat_extractor_ball.prepool.1", "features/scale_0", "features/shift_0"),
    ("feat_extractor_ball.prepool.3", "features/kernel_1", "features/bias_1"),
    ("feat_extractor_ball.prepool.4", "features/scale_1", "features/shift_1"),
    ("feat_extractor_ball.prepool.6", "features/kernel_2", "features/bias_2"),
    ("feat_extractor_ball.prepool.7", "features/scale_2", "features/shift_2"),
)
_RPMNET: Layers = (
    *_ANNEALING,
    (
        "feat_extractor.prepool.0",
        "features/neighbor_0_dense/kernel",
        "features/neighbor_0_dense/bias",
    ),
    ("feat_extractor.prepool.1", "features/neighbor_0_scale", "features/neighbor_0_shift"),
    (
        "feat_extractor.prepool.3",
        "features/neighbor_1_dense/kernel",
        "features/neighbor_1_dense/bias",
    ),
    ("feat_extractor.prepool.4", "features/neighbor_1_scale", "features/neighbor_1_shift"),
    (
        "feat_extractor.prepool.6",
        "features/neighbor_2_dense/kernel",
        "features/neighbor_2_dense/bias",
    ),
    ("feat_extractor.prepool.7", "features/neighbor_2_scale", "features/neighbor_2_shift"),
    ("feat_extractor.postpool.0", "features/point_0_dense/kernel", "features/point_0_dense/bias"),
    ("feat_extractor.postpool.1", "features/point_0_scale", "features/point_0_shift"),
    ("feat_extractor.postpool.3", "features/point_1_dense/kernel", "features/point_1_dense/bias"),
    ("feat_extractor.postpool.4", "features/point_1_scale", "features/point_1_shift"),
    ("feat_extractor.postpool.6", "features/out/kernel", "features/out/bias"),
)
_LAYERS_PER_ITERATION = (
    # one of each for every iteration {}, stacked here on a leading axis
    ("feat_extractor_xyz.nets_a.{}.0", "cascade/scale", "cascade/shift"),
    ("feat_extractor_xyz.nets_a.{}.2", "cascade/kernel", "cascade/bias"),
    ("feat_extractor_xyz.nets_b.{}.0", "cascade/position", None),
)
_ITERATION = re.compile(r"feat_extractor_xyz\.nets_a\.(\d+)\.")
_OF_CFR = ("feat_extractor_ball.", "feat_extractor_xyz.")
_OF_RPMNET = "feat_extractor."


def convert(path: str | Path) -> dict:
    """Parameters from a checkpoint of the CFR or the RPM-Net authors' program.

    Which of the two is told by its names; `weights.network_of` says which it was. `path` is a
    PyTorch file (.pth or .pt, needs torch; tensors alone are read, no object is ever unpickled), or
    a .safetensors or .npz file of the same tensors under the same names. Of CFR as many iterations
    as it holds are kept. Raises ValueError naming every tensor that is missing, unknown, of a wrong
    shape, or not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"path: there is no checkpoint at {path}")
    readers = {".pth": _read_torch, ".pt": _read_torch}
    readers |= {".safetensors": load_file, ".npz": _read_npz}
    if path.suffix not in readers:
        raise ValueError(f"path: got a checkpoint {path.name}, wanted one of {', '.join(readers)}")
    try:
        state = readers[path.suffix](path)
    except ImportError as error:
        raise ValueError(
            f'path: {path.name} is a PyTorch file: pip install "cfr_jax[torch]" to read it'
        ) from error
    except Exception as error:  # a damaged archive may raise anything
        raise ValueError(f"path: {path} is no readable checkpoint ({error})") from error
    return from_state_dict(state, str(path))


def from_state_dict(state: dict[str, np.ndarray], name: str = "state_dict") -> dict:
    """`convert` for tensors that are already in memory, as arrays; `name` stands in errors."""
    kind = _kind_of(state)
    iterations = max(1, len({found[1] for found in map(_ITERATION.match, state) if found}))
    fresh, homes = rpmnet.init_params, _homes(_RPMNET, 0)
    if kind == "cfr":
        fresh = functools.partial(network.init_params, iterations=iterations)
        homes = _homes(_CFR, iterations)
    ours = jax.eval_shape(fresh, jax.random.key(0))
    shapes = {key: leaf.shape for key, leaf in flatten_dict(ours, sep="/").items()}
    faults = [f"{theirs} is missing" for theirs in homes if theirs not in state]
    faults += [f"{theirs} is unknown" for theirs in state if theirs not in homes]
    found: dict[str, list[np.ndarray]] = {}
    for theirs, (home, stacked) in homes.items():
        if theirs not in state:
            continue
        value, shape = state[theirs], shapes[home][1:] if stacked else shapes[home]
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
        found.setdefault(home, []).append(value)
    if faults:
        raise ValueError(f"{name} does not hold {NETWORKS[kind]}: {'; '.join(faults)}")
    joined = {
        home: np.stack(v) if home.startswith("cascade/") else v[0] for home, v in found.items()
    }
    return unflatten_dict({home: jnp.asarray(value) for home, value in joined.items()}, sep="/")


def _kind_of(names: Iterable[str]) -> str:
    """The network that has tensors of these names; CFR where none of them tells."""
    of_cfr = any(name.startswith(_OF_CFR) for name in names)
    of_rpmnet = any(name.startswith(_OF_RPMNET) for name in names)
    return "rpmnet" if of_rpmnet and not of_cfr else "cfr"


def _homes(layers: Layers, iterations: int) -> dict[str, tuple[str, bool]]:
    """Where each of their tensors goes, in the order of stacking, and whether it is stacked."""
    rows = [(theirs, weight, bias, False) for theirs, weight, bias in layers]
    rows += [
        (theirs.format(i), weight, bias, True)
        for i in range(iterations)
        for theirs, weight, bias in _LAYERS_PER_ITERATION
    ]
    homes = {}
    for theirs, weight, bias, stacked in rows:
        homes[f"{theirs}.weight"] = (weight, stacked)
        if bias is not None:
            homes[f"{theirs}.bias"] = (bias, stacked)
    return homes


def _squeezed(shape: tuple[int, ...], axes: int) -> tuple[int, ...]:
    """The shape without the last axes of a 1x1 convolution."""
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
