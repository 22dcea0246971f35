"""Measurements that were not written yet, kept in a checkpoint.

A run that was stopped between two lines of `metrics.jsonl` then writes the same next line as one
that was not.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from cfr_jax.training.losses import PairLoss


def pack(measured: Sequence[PairLoss]) -> list[Any]:
    """As JSON, every bit kept: for each of the losses, the shape, type and bytes of its leaves."""
    return [
        [_packed(np.asarray(leaf)) for leaf in jax.tree.leaves(jax.device_get(losses))]
        for losses in measured
    ]


def unpack(packed: Sequence[Any]) -> list[PairLoss]:
    """What was packed, as arrays on the host."""
    held: list[list[Any]] = [list(map(_unpacked, leaves)) for leaves in packed]
    return [PairLoss(*leaves) for leaves in held]


def _packed(leaf: np.ndarray) -> list[Any]:
    return [list(leaf.shape), leaf.dtype.str, base64.b64encode(leaf.tobytes()).decode("ascii")]


def _unpacked(held: Sequence[Any]) -> np.ndarray:
    shape, kind, data = held
    return np.frombuffer(base64.b64decode(data), np.dtype(kind)).reshape(shape)
