"""Reads a 4x4 transform from a file."""

from __future__ import annotations

import re
import warnings
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from cfr_jax.runtime.messages import Refused, shown
from cfr_jax.runtime.reading import contents, parse_json

_LARGEST_FILE = 1 << 21  # bytes; a result with its transforms has a few thousand
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?|[+-]?(?:nan|inf)")


def read_transform(path: Path) -> Float64[np.ndarray, "4 4"]:
    """The matrix in a text file of 16 numbers, a .npy, or a .json.

    JSON holds the matrix as four rows, or is an object with such a "transform", as
    `cfr register --json` writes. Raises ValueError, naming the file, for anything but 16 finite
    numbers; whether they are a rigid motion is for whoever uses them to say.
    """
    try:
        data = contents(path, _LARGEST_FILE)
    except Refused as error:
        raise Refused(f"{shown(path)}: {error}") from error
    try:
        match path.suffix.lower():
            case ".npy":
                return _from_array(_parse_npy(data))
            case ".json":
                return _from_array(_parse_json(data))
            case _:
                return _from_array(_parse_text(data))
    except Refused as error:
        raise Refused(f"{shown(path)}: wanted a 4x4 transform: {error}") from error


def matrix_of(value: Any) -> Float64[np.ndarray, "4 4"]:
    """A JSON value as a matrix; raises ValueError unless it is four rows of four numbers."""
    if not isinstance(value, list) or len(value) != 4:
        raise Refused("wanted a list of four rows")
    if not all(isinstance(row, list) and len(row) == 4 for row in value):
        raise Refused("wanted rows of four numbers")
    if not all(is_number(entry) for row in value for entry in row):
        raise Refused("holds an entry that is no number")
    return np.array([[float(entry) for entry in row] for row in value])


def is_number(value: Any) -> bool:
    """Whether a JSON value is a number; True and False are none."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def _from_array(matrix: np.ndarray) -> Float64[np.ndarray, "4 4"]:
    # Text may come as one row of sixteen or four rows of four.
    if matrix.shape not in ((4, 4), (16,)):
        raise Refused(f"holds numbers of the shape {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise Refused("holds a number that is not finite")
    return matrix.reshape(4, 4).astype(np.float64)


def _parse_npy(data: bytes) -> np.ndarray:
    try:
        with warnings.catch_warnings():  # of headers that Python 2 wrote
            warnings.simplefilter("ignore")
            array = np.lib.format.read_array(BytesIO(data), allow_pickle=False)
    except Exception as error:  # a damaged header may raise anything
        raise Refused(f"is no .npy file of numbers ({error})") from error
    if array.dtype.kind not in "fiu":
        raise Refused(f"holds {array.dtype}, wanted floats or integers")
    return array


def _parse_json(data: bytes) -> np.ndarray:
    value = parse_json(data)
    if isinstance(value, dict):
        if "transform" not in value:
            raise Refused('has no "transform"')
        value = value["transform"]
    if isinstance(value, list) and len(value) == 16:
        value = [value[row : row + 4] for row in range(0, 16, 4)]
    return matrix_of(value)


def _parse_text(data: bytes) -> np.ndarray:
    try:
        words = data.decode("utf-8-sig").replace(",", " ").split(maxsplit=16)
    except UnicodeDecodeError as error:
        raise Refused(f"is no text in UTF-8 (byte {error.start})") from error
    if len(words) != 16:
        raise Refused(f"holds {min(len(words), 16)} numbers" + (" and more" * (len(words) > 16)))
    for word in words:
        if _NUMBER.fullmatch(word.lower()) is None:
            raise Refused(f"{shown(repr(word))} is no number")
    return np.array([float(word) for word in words])
