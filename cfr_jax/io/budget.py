"""How much memory the contents of a file may take: 64 MB and four times the file.

The file itself is one part of that. What is left is for what its rows become, which is counted
before they are unfolded.
"""

from __future__ import annotations

from cfr_jax.io.cloud import CloudFileError

_ALWAYS_ALLOWED, _PER_BYTE = 40 << 20, 2.5


def room(size: int) -> float:
    """Bytes that may be made of a file of `size` bytes, without the file itself."""
    return _ALWAYS_ALLOWED + _PER_BYTE * size


def check_room(count: int, each: int, size: int, what: str) -> None:
    """Raises CloudFileError if `count` rows of `each` bytes are too many for a file of `size`."""
    if count * each > room(size):
        raise CloudFileError(
            f"{count} {what} in {size} bytes are more than we read, wanted a smaller file or one "
            "with more bytes to each"
        )
