"""NPY: one array, plain or with named fields."""

from __future__ import annotations

import ast
import math
import re

import numpy as np

from cfr_jax.io.budget import POINT, check_room
from cfr_jax.io.cloud import CloudFileError, PointCloud
from cfr_jax.io.mesh import Mesh
from cfr_jax.io.naming import HOW_TO_SAY
from cfr_jax.io.table import Table, table_of, unnamed_table

_DESCR = re.compile(r"""['"]descr['"]\s*:\s*(['"][<>|=]?[A-Za-z]\w*['"]|\[[^\]]*\])""")
_ORDER = re.compile(r"""['"]fortran_order['"]\s*:\s*(True|False)\b""")
_SHAPE = re.compile(r"""['"]shape['"]\s*:\s*\(([\d,\s]*)\)""")
_LONGEST_HEADER = 10_000
_KINDS = "fiubSU"  # words and flags may stand beside the points


def parse(
    data: bytes, name: str, *, columns: tuple[str, ...] | None = None, whole: bool = False
) -> PointCloud | Mesh:
    """An (n, 3) array or wider, of floats or integers, or a structured array with x, y, z.

    Axes before the last are rows: (1, n, 3) and the grid (h, w, 3) of an organized cloud are n and
    h * w points.
    """
    table, notes = table_of_array(read_array(data), columns, len(data))
    return table.shape(name, notes, whole)


def table_of_array(
    array: np.ndarray, columns: tuple[str, ...] | None, size: int, taken: int = 0
) -> tuple[Table, tuple[str, ...]]:
    """The columns of an array that a file of `size` bytes holds, and notes on their meaning.

    The array itself has `taken` bytes of memory beside the file.
    """
    if not array.dtype.names and array.dtype.kind not in "fiu":
        raise CloudFileError(f"holds {array.dtype}, wanted floats or integers")
    if not array.dtype.names and array.ndim not in (2, 3):
        raise CloudFileError(f"the shape is {array.shape}, wanted (n, 3) or (n, 6)")
    if array.ndim == 3 and array.dtype == np.uint8 and columns is None:
        raise CloudFileError(f"is {array.shape} of bytes, an image? {HOW_TO_SAY}")
    rows = array.size if array.dtype.names else array.size // max(array.shape[-1], 1)
    each = POINT if array.dtype.names or array.shape[-1] != 6 else 3 * POINT  # normals and units
    check_room(rows, each, size, f"points of {array.dtype!s:.60}", taken)
    if array.dtype.names:
        rows_of_all = array.reshape(-1)
        names = list(array.dtype.names)
        return table_of(names, [rows_of_all[name] for name in names], columns, format="NPY"), ()
    flat = array.reshape(-1, array.shape[-1])
    return unnamed_table([flat[:, k] for k in range(flat.shape[1])], columns, format="NPY")


def read_array(data: bytes) -> np.ndarray:
    """The array of an NPY file.

    Read here and not by `np.load`, which evaluates the header as a Python literal and raises a
    dozen kinds of errors and warnings for a damaged one.
    """
    if data[:6] != b"\x93NUMPY":
        raise CloudFileError(f"byte 0: is {data[:6]!r}, wanted the NPY mark b'\\x93NUMPY'")
    size_bytes = 2 if data[6:7] == b"\x01" else 4
    start = 8 + size_bytes
    length = int.from_bytes(data[8:start], "little")
    if length > _LONGEST_HEADER or start + length > len(data):
        raise CloudFileError(f"byte 8: a header of {length} bytes, the file has {len(data)}")
    header = data[start : start + length].decode("latin1")
    descr, order, shape = (pattern.search(header) for pattern in (_DESCR, _ORDER, _SHAPE))
    if descr is None or order is None or shape is None:
        raise CloudFileError(
            f"byte {start}: wanted a header with descr (a number type), fortran_order and shape, "
            f"got {header.strip()[:80]!r}"
        )
    dtype = _dtype(descr[1], start)
    cells = shape[1].replace(",", " ").split()
    if len(cells) > 8 or any(len(cell) > 18 for cell in cells):
        raise CloudFileError(f"byte {start}: the shape is ({shape[1]}), wanted (n, 3) or (n, 6)")
    sizes = tuple(int(cell) for cell in cells)
    start += length
    if math.prod(sizes) * dtype.itemsize != len(data) - start:
        raise CloudFileError(
            f"byte {start}: {sizes} of {dtype} are {math.prod(sizes) * dtype.itemsize} bytes, "
            f"the file holds {len(data) - start}"
        )
    if dtype.itemsize == 0:
        raise CloudFileError(f"byte {start}: holds {dtype}, wanted floats or integers")
    array = np.frombuffer(data, dtype, offset=start)
    return array.reshape(sizes, order="F" if order[1] == "True" else "C")


def _dtype(text: str, start: int) -> np.dtype:
    """The type that a header names: a number, or fields of numbers."""
    try:
        said = ast.literal_eval(text)
        if isinstance(said, list):
            fields = [(str(field[0]), str(field[1]), *field[2:]) for field in said]
            dtype = np.dtype(fields)
        else:
            dtype = np.dtype(said)
    except (TypeError, ValueError, SyntaxError, IndexError, RecursionError, MemoryError):
        raise CloudFileError(f"byte {start}: unknown number type {text!r:.80}") from None
    if dtype.names is None:
        if dtype.kind not in _KINDS:
            raise CloudFileError(f"byte {start}: holds {dtype}, wanted floats or integers")
        return dtype
    for name in dtype.names:
        inner = dtype[name].base
        if inner.kind not in _KINDS or inner.names or len(dtype[name].shape) > 1:
            raise CloudFileError(f"byte {start}: field {name!r} is {dtype[name]}, wanted numbers")
    return dtype
