"""The chunks of a LAZ file, gone through before they are unpacked.

The decoder, lazrs, allocates what sizes within the file ask for, gigabytes if one bit is wrong.
Here those sizes are added up first: they have to fit into the file.
"""

from __future__ import annotations

import struct

import numpy as np

from .cloud import CloudFileError

_CHUNKED, _LAYERED = 2, 3
# Compressed layers of each kind of field, by its number: point, color, color with infrared,
# waveform. The last kind, bytes of one's own, has a layer for each.
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
_OWN_BYTES = 14
# The most points per byte we unpack; points all alike take more than a fortieth of a byte each.
_DENSEST = 64


def check_chunks(data: bytes, start: int, count: int, row_size: int, record: bytes) -> None:
    """Refuses points that cannot be `count` rows of `row_size` bytes within the file.

    `record` is what the file says of its compression; the points begin at byte `start`.
    """
    compressor, fields = _fields(record)
    if compressor not in (_CHUNKED, _LAYERED) or sum(size for _, size in fields) != row_size:
        raise CloudFileError(
            f"compressed by the method {compressor} in fields {fields}, "
            f"wanted {_CHUNKED} or {_LAYERED} and rows of {row_size} bytes"
        )
    (chunk_size,) = struct.unpack_from("<I", record, 12)
    table = _table_position(data, start)
    (chunks,) = struct.unpack_from("<I", data, table + 4)
    # Each chunk opens with a point that is not compressed.
    possible = min(chunks * chunk_size, _DENSEST * (table - start))
    if chunks * row_size > table - start or possible < count:
        raise CloudFileError(
            f"byte {table}: {chunks} chunks of {chunk_size} points in {table - start} bytes, "
            f"wanted {count} points"
        )
    if compressor == _LAYERED:
        held = _walk_layers(data, start + 8, table, chunks, row_size, fields)
        if held < count:
            raise CloudFileError(f"byte {start}: the chunks hold {held} points, wanted {count}")


def _fields(record: bytes) -> tuple[int, list[tuple[int, int]]]:
    """The method of compression, and the kind and size of each field of a point."""
    if len(record) < 34:
        raise CloudFileError(f"a 'laszip encoded' record of {len(record)} bytes, wanted 34 or more")
    (compressor,) = struct.unpack_from("<H", record, 0)
    (count,) = struct.unpack_from("<H", record, 32)
    if 34 + 6 * count > len(record):
        raise CloudFileError(f"{count} compressed fields, told in {len(record) - 34} bytes")
    described = struct.iter_unpack("<HHH", record[34 : 34 + 6 * count])
    return compressor, [(kind, size) for kind, size, _ in described]


def _table_position(data: bytes, start: int) -> int:
    if start + 16 > len(data):
        raise CloudFileError(f"byte {len(data)}: the file ends before the compressed points")
    (table,) = struct.unpack_from("<q", data, start)
    if table == -1:  # written as a stream: the position stands at the very end
        (table,) = struct.unpack_from("<q", data, len(data) - 8)
    if not start + 8 <= table <= len(data) - 8:
        raise CloudFileError(
            f"byte {start}: the table of chunks is at byte {table}, wanted {start + 8} to "
            f"{len(data) - 8}"
        )
    return table


def _walk_layers(
    data: bytes, position: int, end: int, chunks: int, row_size: int, fields: list[tuple[int, int]]
) -> int:
    """The points in all chunks; each is a point, a count, the sizes of its layers, and those."""
    layers = sum(size if kind == _OWN_BYTES else _LAYERS.get(kind, 0) for kind, size in fields)
    held = 0
    for chunk in range(chunks):
        sizes_at = position + row_size + 4
        body = sizes_at + 4 * layers
        if body > end:
            raise CloudFileError(f"byte {position}: ends within chunk {chunk} of {chunks}")
        held += struct.unpack_from("<I", data, sizes_at - 4)[0]
        position = body + int(np.frombuffer(data, "<u4", layers, sizes_at).sum(dtype=np.int64))
        if position > end:
            raise CloudFileError(
                f"byte {sizes_at}: the layers of chunk {chunk} end at byte {position}, "
                f"the points at byte {end}"
            )
    return held
