"""PCD: text, binary, and compressed binary.

Read here because pypcd4, the one library that is kept up, trusts the counts of the header, and
needs pydantic for what is a page of numpy.
"""

from __future__ import annotations

import struct

import numpy as np

from cfr_jax.io.budget import POINT, check_room
from cfr_jax.io.cloud import CloudFileError, PointCloud
from cfr_jax.io.formats.pcd.header import Header, parse_header
from cfr_jax.io.formats.text.lines import Text, clean_text
from cfr_jax.io.mesh import Mesh
from cfr_jax.io.table import Table, table_of

FORMAT = "PCD"
PADDING = "_"
_LARGEST_RATIO = 88  # of LZF: three bytes repeat at most 264


def parse(
    data: bytes, name: str, *, columns: tuple[str, ...] | None = None, whole: bool = False
) -> PointCloud | Mesh:
    """x, y, z and, if there, the normals, which the names of the fields say.

    Rows with NaN in x, y or z are the empty cells of an organized cloud: they are left out and
    counted in `left_out`. VIEWPOINT is not applied: points stay in the frame of the sensor.
    """
    header = parse_header(data)
    if header.storage == "ascii":
        values = _read_text(data, header)
    elif header.storage == "binary":
        values = _read_rows(data, header)
    else:
        values = _read_compressed(data, header)
    check_room(header.points, POINT, len(data), "points")
    return _table(header, values, columns, whole).shape(name, (), whole)


def _table(
    header: Header, values: list[np.ndarray], columns: tuple[str, ...] | None, whole: bool
) -> Table:
    """The fields, without padding; fields of several numbers only if all are wanted."""
    kept = [
        k
        for k, (label, column) in enumerate(zip(header.fields, values, strict=True))
        if label != PADDING and (whole or column.ndim == 1)
    ]
    try:
        return table_of(
            [header.fields[k] for k in kept],
            [values[k] for k in kept],
            columns,
            rest=header if whole else None,
            format=FORMAT,
        )
    except ValueError as error:
        raise CloudFileError(f"FIELDS: {error}") from None


def _read_text(data: bytes, header: Header) -> list[np.ndarray]:
    text = Text(clean_text(data), header.body, header.lines + 1)
    table = text.take(header.points, "points").table(each=POINT)
    width = sum(header.repeats)
    if len(table) and table.shape[1] != width:
        raise CloudFileError(
            f"line {header.lines + 1}: wanted {width} numbers per point, got {table.shape[1]}"
        )
    if not len(table):
        table = np.empty((0, width))
    values = []
    start = 0
    for kind, repeat in zip(header.kinds, header.repeats, strict=True):
        part = table[:, start : start + repeat]
        values.append(_cast(part[:, 0] if repeat == 1 else part, kind))
        start += repeat
    return values


def _cast(values: np.ndarray, kind: str) -> np.ndarray:
    """Whole numbers in the type of the header, if it holds them; floats keep all their digits."""
    if np.dtype(kind).kind == "f" or values.size == 0:
        return values
    with np.errstate(all="ignore"):
        cast = values.astype(kind)
    return cast if np.array_equal(cast, values) else values


def _read_rows(data: bytes, header: Header) -> list[np.ndarray]:
    size = header.points * header.row_size
    if header.body + size > len(data):
        raise CloudFileError(
            f"byte {header.body}: {header.points} points of {header.row_size} bytes are {size}, "
            f"the file holds {len(data) - header.body}"
        )
    # Offsets instead of a dtype of all fields: padding is called "_" as often as there is some.
    values = []
    offset = 0
    for kind, repeat in zip(header.kinds, header.repeats, strict=True):
        width = np.dtype(kind).itemsize
        shape = (header.points,) if repeat == 1 else (header.points, repeat)
        strides = (header.row_size, width)[: len(shape)]
        values.append(np.ndarray(shape, kind, data, header.body + offset, strides))
        offset += width * repeat
    return values


def _read_compressed(data: bytes, header: Header) -> list[np.ndarray]:
    """One field after the other, compressed together."""
    start = header.body + 8
    if start > len(data):
        raise CloudFileError(f"byte {len(data)}: the file ends before the compressed points")
    packed, unpacked = struct.unpack_from("<II", data, header.body)
    size = header.points * header.row_size
    if start + packed > len(data) or unpacked != size or size > _LARGEST_RATIO * packed:
        raise CloudFileError(
            f"byte {header.body}: {packed} bytes that unfold to {unpacked}, wanted {size} bytes "
            f"({header.points} points) from at most {len(data) - start}"
        )
    check_room(header.points, POINT + header.row_size, len(data), "points")
    raw = _unfolded(data[start : start + packed], size)
    if raw is None or len(raw) != size:
        raise CloudFileError(f"byte {start}: the compressed points are damaged")
    values = []
    offset = 0
    for kind, repeat in zip(header.kinds, header.repeats, strict=True):
        count = header.points * repeat
        part = np.frombuffer(raw, kind, count, offset)
        values.append(part if repeat == 1 else part.reshape(header.points, repeat))
        offset += np.dtype(kind).itemsize * count
    return values


def _unfolded(packed: bytes, size: int) -> bytes | None:
    """What LZF compressed, by the library that has it; None for damaged bytes."""
    try:
        import lzf
    except ImportError:
        raise CloudFileError(
            "compressed PCD needs the package python-neo-lzf: pip install python-neo-lzf"
        ) from None
    try:
        return lzf.decompress(packed, size)
    except ValueError:
        return None
