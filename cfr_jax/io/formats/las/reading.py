"""LAS and LAZ: coordinates are 32-bit integers with a scale and an offset.

LAS is read here: the header has to be checked against the file anyway (laspy spends seconds on a
flipped count of records), and the coordinates stand in plain rows behind it. LAZ is unpacked by
`lazrs`, the decoder that laspy uses.
"""

from __future__ import annotations

import io
import struct
from types import ModuleType

import numpy as np
from jaxtyping import Float64, Int32, UInt8

from cfr_jax.io.budget import POINT, room
from cfr_jax.io.cloud import CloudFileError, PointCloud
from cfr_jax.io.formats.las.chunks import check_chunks
from cfr_jax.io.formats.las.fields import properties
from cfr_jax.io.table import cloud_of_filled, table_of

# Bytes of a point in the formats 0 to 10; a file's rows may be longer, by fields of its own.
_ROW_SIZES = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
_RECORD_HEADER = 54
_LASZIP = (b"laszip encoded", 22204)
_EXTRA_BYTES = (b"LASF_Spec", 4)
_ROWS_AT_ONCE, _BYTES_AT_ONCE = 1 << 16, 1 << 22


def parse(
    data: bytes, name: str, *, columns: tuple[str, ...] | None = None, whole: bool = False
) -> PointCloud:
    """x, y, z in the file's unit, scaled and offset as its header says."""
    if columns is not None:
        raise CloudFileError("columns: LAS files say themselves what they hold")
    if data[:4] != b"LASF":
        raise CloudFileError(f"byte 0: starts with {data[:4]!r}, wanted b'LASF'")
    major, minor = data[24:26] if len(data) >= 26 else (0, 0)
    smallest = 375 if minor >= 4 else 227
    if major != 1 or minor > 4 or len(data) < smallest:
        raise CloudFileError(
            f"byte 24: version {major}.{minor} with {len(data)} bytes, wanted LAS 1.0 to 1.4 "
            f"with a header of {smallest} bytes"
        )
    header_size, start, records, kind, row_size, count = struct.unpack_from("<HIIBHI", data, 94)
    if minor >= 4:
        (count,) = struct.unpack_from("<Q", data, 247)
    scale, offset = np.frombuffer(data, "<f8", 6, 131).reshape(2, 3)
    if not smallest <= header_size <= start <= len(data):
        raise CloudFileError(
            f"byte 94: a header of {header_size} bytes, points from byte {start}; "
            f"wanted {smallest} <= header <= points <= {len(data)}"
        )
    if not (np.isfinite(scale).all() and np.isfinite(offset).all() and (scale != 0).all()):
        raise CloudFileError(f"byte 131: the scale is {scale}, the offset is {offset}")
    layout = kind & 0x3F
    if layout >= len(_ROW_SIZES) or row_size < _ROW_SIZES[layout]:
        raise CloudFileError(f"byte 104: point format {layout} with rows of {row_size} bytes")
    if count == 0:
        raise CloudFileError("holds no points, wanted at least one")

    rows: UInt8[np.ndarray, "n size"] | None = None
    if kind & 0xC0:
        record = _record(data, header_size, start, records, _LASZIP)
        if record is None:
            raise CloudFileError("wanted a 'laszip encoded' record, found none")
        points, rows = _unpack(data, start, count, row_size, record, whole, scale, offset)
    else:
        if start + count * row_size > len(data):
            raise CloudFileError(
                f"byte {start}: {count} points of {row_size} bytes are {count * row_size}, "
                f"the file holds {len(data) - start}"
            )
        integers = np.ndarray((count, 3), "<i4", data, start, (row_size, 4))
        rows = np.ndarray((count, row_size), np.uint8, data, start)
        points = _scaled(integers, scale, offset)
    if not whole or rows is None:
        return cloud_of_filled(points, None, name)
    described = _record(data, header_size, start, records, _EXTRA_BYTES) or b""
    names, values = properties(rows, layout, described)
    table = table_of(["x", "y", "z", *names], [*points.T, *values], format="LAS")
    return cloud_of_filled(points, None, name, (), table)


def _scaled(
    integers: Int32[np.ndarray, "n 3"],
    scale: Float64[np.ndarray, " 3"],
    offset: Float64[np.ndarray, " 3"],
) -> Float64[np.ndarray, "n 3"]:
    with np.errstate(over="ignore"):  # an absurd scale gives infinity, which PointCloud refuses
        points = integers * scale
        points += offset
    return points


def _record(
    data: bytes, position: int, end: int, records: int, wanted: tuple[bytes, int]
) -> bytes | None:
    """The record of this user and number among those before the points, if there is one."""
    for _ in range(min(records, (end - position) // _RECORD_HEADER)):
        if position + _RECORD_HEADER > end:
            break
        user, number, size = struct.unpack_from("<2x16sHH", data, position)
        body = position + _RECORD_HEADER
        position = body + size
        if (user.rstrip(b"\0"), number) == wanted and position <= end:
            return data[body:position]
    return None


def _unpack(
    data: bytes,
    start: int,
    count: int,
    row_size: int,
    record: bytes,
    whole: bool,
    scale: Float64[np.ndarray, " 3"],
    offset: Float64[np.ndarray, " 3"],
) -> tuple[Float64[np.ndarray, "n 3"], UInt8[np.ndarray, "n size"] | None]:
    """The coordinates, and all bytes of the points if they are wanted as a whole."""
    lazrs = _import_lazrs()
    check_chunks(data, start, count, row_size, record)
    _check_count(count, row_size, len(data), whole)
    points = np.empty((count, 3))
    held = np.empty((count, row_size), np.uint8) if whole else None
    at_once = max(1, min(count, _ROWS_AT_ONCE, _BYTES_AT_ONCE // row_size))
    rows = np.empty((at_once, row_size), np.uint8)
    done = 0
    try:
        stream = io.BytesIO(data)
        stream.seek(start)
        unpacker = lazrs.LasZipDecompressor(stream, record)
        while done < count:
            part = rows[: count - done]
            unpacker.decompress_many(part.reshape(-1))
            integers = part[:, :12].copy().view("<i4")
            points[done : done + len(part)] = _scaled(integers, scale, offset)
            if held is not None:
                held[done : done + len(part)] = part
            done += len(part)
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # a panic of Rust code arrives as no `Exception`
        raise CloudFileError(
            f"byte {start}: cannot unpack points {done} and following of {count}: {error}"
        ) from None
    return points, held


def _check_count(count: int, row_size: int, size: int, whole: bool) -> None:
    """Refuses more points than the budget allows: those along a line take no bytes at all.

    Decoding takes time by the byte, also of what is not kept.
    """
    # Beside its bytes, a row has a dozen values of a byte that were bits, and perhaps a copy of
    # what is behind its known fields.
    each = POINT + 2 * row_size if whole else POINT
    if max(count * each, count * row_size / 2) > room(size):
        raise CloudFileError(
            f"{count} points in {size} bytes are more than we read, wanted a smaller file, or the "
            "same points as .las"
        )


def _import_lazrs() -> ModuleType:
    try:
        import lazrs
    except ImportError:
        raise CloudFileError(
            'LAZ files need the package lazrs: pip install "cfr_jax[io]"'
        ) from None
    return lazrs
