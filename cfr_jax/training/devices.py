"""The devices of a training, and how states and batches are distributed over them.

Training is data parallel: every device holds the whole state and a share of each batch. With
several processes (`join`), each makes and holds only the shares of its own devices.
"""

from __future__ import annotations

import math
import os
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

AXIS = "data"


def join(coordinator: str, processes: int, process: int) -> None:
    """Makes this process number `process` of `processes`, which meet at `coordinator`.

    Call it before anything else in JAX. Without a `coordinator`, there is only this process. Raises
    ValueError for numbers that do not fit. If the other processes are not found within five
    minutes, JAX ends this process with a message.
    """
    if not coordinator:
        if processes != 1 or process != 0:
            raise ValueError(
                f"processes: got {processes}, wanted 1 because there is no coordinator; "
                "give --coordinator=HOST:PORT, the same for all processes"
            )
        return
    if not 0 <= process < processes:
        raise ValueError(f"process: got {process}, wanted 0 to {processes - 1}")
    jax.distributed.initialize(coordinator, num_processes=processes, process_id=process)


def of_cores(*batches: int) -> int | None:
    """How many devices to make from a CPU's cores (JAX's option `jax_num_cpu_devices`).

    It is the largest number over which all `batches` can be spread evenly. Each pair then runs on
    its own core; otherwise every operation would end with cores waiting for each other. None if the
    environment sets a number, by JAX_NUM_CPU_DEVICES or by --xla_force_host_platform_device_count
    in XLA_FLAGS.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "JAX_NUM_CPU_DEVICES" in os.environ or "xla_force_host_platform_device_count" in flags:
        return None
    affinity = getattr(os, "sched_getaffinity", None)  # Linux: the cores this process may use
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    common = math.gcd(*batches)
    return max(number for number in range(1, cores + 1) if common % number == 0)


def make_mesh() -> Mesh:
    """A one-dimensional mesh of all devices of all processes."""
    return jax.make_mesh((jax.device_count(),), (AXIS,), axis_types=(AxisType.Auto,))


def is_first() -> bool:
    """Whether this process is the one that writes files and messages."""
    return jax.process_index() == 0


def replicate(tree: Any, mesh: Mesh) -> Any:
    """Puts the same values on every device; every process must have them."""
    here = NamedSharding(mesh, P())
    return jax.tree.map(
        lambda leaf: jax.make_array_from_callback(
            np.shape(leaf), here, lambda index: np.asarray(leaf)[index]
        ),
        tree,
    )


def share_of(size: int) -> slice:
    """The rows of a batch of `size` pairs that this process makes."""
    mine = size // jax.process_count()
    return slice(jax.process_index() * mine, (jax.process_index() + 1) * mine)


def spread(batch: dict[str, np.ndarray], mesh: Mesh) -> dict[str, jax.Array]:
    """Spreads a batch over the devices; each process provides its rows, as `share_of` says."""
    rows = NamedSharding(mesh, P(AXIS))
    return {key: jax.make_array_from_process_local_data(rows, batch[key]) for key in batch}


def spread_steps(rows: np.ndarray, mesh: Mesh) -> jax.Array:
    """Spreads rows (k, b, ...) of k batches over the devices along b; each process provides its
    share."""
    return jax.make_array_from_process_local_data(NamedSharding(mesh, P(None, AXIS)), rows)


def gather(values: jax.Array) -> np.ndarray:
    """All rows of an array that is spread over the devices, in every process."""
    return np.asarray(multihost_utils.process_allgather(values, tiled=True))


def agree(number: int) -> int:
    """The `number` of the first process, in every process."""
    return int(multihost_utils.broadcast_one_to_all(np.int32(number)))


def check_batch(size: int, pairs_at_once: int, mesh: Mesh) -> None:
    """Raises ValueError if a batch cannot be spread evenly."""
    if mesh.size != jax.local_device_count() * jax.process_count():
        raise ValueError(
            f"processes: this one has {jax.local_device_count()} of {mesh.size} devices, wanted "
            "equally many in each process"
        )
    share, rest = divmod(size, mesh.size)
    if rest or not share:
        raise ValueError(f"batch: got {size} pairs, wanted a multiple of the {mesh.size} devices")
    if pairs_at_once < 1 or share % min(pairs_at_once, share):
        raise ValueError(
            f"pairs_at_once: got {pairs_at_once}, wanted a divisor of the {share} pairs per device"
        )
