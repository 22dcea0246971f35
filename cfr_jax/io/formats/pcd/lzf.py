"""LZF (Marc Lehmann's LibLZF), the compression within PCD files."""

from __future__ import annotations

from cfr_jax.io.cloud import CloudFileError

# Three bytes repeat at most 264.
LARGEST_RATIO = 88


def decompress(data: bytes, position: int, end: int, size: int) -> bytearray:
    """The `size` bytes that `data[position:end]` unfolds to; memory stays within `size`.

    A control byte below 32 precedes that many literals plus one; any other holds, with the one
    or two bytes that follow it, the length and the distance of a repetition.
    """
    out = bytearray()
    try:
        while position < end and len(out) <= size:
            control = data[position]
            position += 1
            if control < 32:
                out += data[position : position + control + 1]
                position += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[position]
                position += 1
            distance = ((control & 31) << 8) + data[position] + 1
            position += 1
            start, length = len(out) - distance, length + 2
            if start < 0:
                raise CloudFileError(f"byte {position}: a repetition from before the beginning")
            if distance >= length:
                out += out[start : start + length]
            else:  # the repetition overlaps what it writes
                out += (out[start:] * (length // distance + 1))[:length]
    except IndexError:
        raise CloudFileError(f"byte {len(data)}: the compressed points break off") from None
    if position != end or len(out) != size:
        raise CloudFileError(f"byte {position}: {len(out)} bytes unfolded, wanted {size}")
    return out
