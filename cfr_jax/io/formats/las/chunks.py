"""The chunks of a LAZ file, gone through before they are unpacked.

The decoder, lazrs, allocates what sizes within the file ask for, gigabytes if one bit is wrong.
Here those sizes are added up first: they have to fit into the file.
"""

from __future__ import annotations

import struct

import numpy as np

from cfr_jax.io.cloud import CloudFileError

_CHUNKED, _LAYERED = 2, 3
# Kinds of fields, by their numbers. Those of old formats are compressed together, with the bytes
# they take: point, time, color, waveform. Those of LAS 1.4 are compressed in layers, and have bytes
# and layers: point, color, color with infrared, waveform. "Extra" bytes are as many as there are,
# with a layer for each.
_JOINT_SIZES = {6: 20, 7: 8, 8: 6, 9: 29}
_LAYERED_SIZES = {10: 30, 11: 6, 12: 8, 13: 29}
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
_JOINT_EXTRA, _LAYERED_EXTRA = 0, 14
# The most points per byte we unpack; a million points evenly along a line are 143 to the byte.
_DENSEST = 256


def check_chunks(data: bytes, start: int, count: int, row_size: int, record: bytes) -> None:
    """Refuses points that cannot be `count` rows of `row_size` bytes within the file.

    `record` is what the file says of its compression; the points begin at byte `start`.
    """
    compressor, fields = _fields(record)
    known = {_CHUNKED: _JOINT_SIZES, _LAYERED: _LAYERED_SIZES}.get(compressor, {})
    extra = _LAYERED_EXTRA if compressor == _LAYERED else _JOINT_EXTRA
    sound = all(kind == extra or known.get(kind) == size for kind, size in fields)
    sound = sound and fields != [] and fields[0][0] == min(known)  # the coordinates come first
    if not sound or sum(size for _, size in fields) != row_size:
        raise CloudFileError(
            f"fields of (kind, bytes) {fields[:8]}, compressed by method {compressor}; "
            f"wanted known ones that make rows of {row_size} bytes, and method 2 or 3"
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
    layers = sum(size if kind == _LAYERED_EXTRA else _LAYERS[kind] for kind, size in fields)
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
