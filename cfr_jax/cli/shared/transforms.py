"""Reads a 4x4 transform from a file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from jaxtyping import Float64

_LARGEST_FILE = 1 << 24  # bytes; a result with its transforms has a few thousand


def read_transform(path: Path) -> Float64[np.ndarray, "4 4"]:
    """The matrix in a text file of 16 numbers, a .npy, or a .json.

    JSON holds the matrix as four rows, or is an object with such a "transform", as
    `cfr register --json` writes it. Raises a ValueError that names the file for anything but 16
    finite numbers. This does not check whether they are a rigid motion.
    """
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise ValueError("is too large for a 4x4 matrix")
        matrix = _parse(path)
        # Text becomes one row of sixteen; other files may hold four rows of four.
        if matrix.shape not in ((4, 4), (16,)):
            raise ValueError(f"holds numbers of the shape {matrix.shape}")
        if not np.isfinite(matrix).all():
            raise ValueError("holds a number that is not finite")
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise ValueError(f"{path}: wanted a 4x4 transform: {error}") from error
    return matrix.reshape(4, 4)


def _parse(path: Path) -> np.ndarray:
    match path.suffix.lower():
        case ".npy":
            return np.asarray(np.load(path, allow_pickle=False), np.float64)
        case ".json":
            value = json.loads(path.read_bytes())
            if isinstance(value, dict):
                if "transform" not in value:
                    raise ValueError('has no "transform"')
                value = value["transform"]
            return np.asarray(value, np.float64)
        case _:
            numbers = path.read_text("utf-8-sig").replace(",", " ").split()
            return np.asarray([float(number) for number in numbers])
