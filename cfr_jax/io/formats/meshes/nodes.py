"""Values of a glTF document, each of the kind that it has to be."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float64

from cfr_jax.io.cloud import CloudFileError

T = TypeVar("T")


def is_moved(node: dict[str, Any]) -> bool:
    """Whether a node says where it is."""
    return not node.keys().isdisjoint(("matrix", "rotation", "scale", "translation"))


def placement(node: dict[str, Any]) -> Float64[np.ndarray, "4 4"]:
    """A node's transform, of its own frame into the one above."""
    if "matrix" in node:
        return _numbers(node, "matrix", [0.0] * 16).reshape(4, 4).T  # stored by columns
    x, y, z, w = _numbers(node, "rotation", [0.0, 0.0, 0.0, 1.0])
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    placed = np.eye(4)
    placed[:3, :3] = rotation * _numbers(node, "scale", [1.0, 1.0, 1.0])
    placed[:3, 3] = _numbers(node, "translation", [0.0, 0.0, 0.0])
    return placed


def _numbers(node: dict[str, Any], key: str, default: list[float]) -> Float64[np.ndarray, " k"]:
    values = get(node, key, list, default)
    good = all(type(v) in (int, float) and abs(v) <= 1e15 for v in values)
    if not good or len(values) != len(default):
        raise CloudFileError(f"{key}: wanted {len(default)} finite numbers, got {str(values)[:80]}")
    return np.array(values, dtype=np.float64)


def get(item: Any, key: str, kind: type[T], default: T | None = None) -> T:
    """`item[key]`, of the kind it has to be; without a default it has to be there."""
    value = item.get(key, default) if isinstance(item, dict) else None
    if type(value) is not kind:
        raise CloudFileError(f"{key}: wanted a JSON {kind.__name__}, got {str(value)[:40]!r}")
    return value
