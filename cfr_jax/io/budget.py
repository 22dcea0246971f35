"""How much memory the contents of a file may take, and how much time.

Reading takes at most 64 MB and four times the file, and a second of one core for 10 MB. The file
itself is one part of that memory, and what is at hand between two steps is another. What is left is
for what the file becomes, which is counted before it is unfolded.
"""

from __future__ import annotations

from cfr_jax.io.cloud import CloudFileError

_ALWAYS_ALLOWED, _PER_BYTE = 48 << 20, 2.75
# A point or a normal in float64, a triangle of three indices and its area.
POINT, TRIANGLE = 24, 32


def room(size: int) -> float:
    """Bytes that may be made of a file of `size` bytes, without the file itself."""
    return _ALWAYS_ALLOWED + _PER_BYTE * size


def check_room(count: int, each: int, size: int, what: str, taken: int = 0) -> None:
    """Raises CloudFileError if `count` rows of `each` bytes, beside `taken` ones that are held
    already, are too many for a file of `size`."""
    if count * each + taken > room(size):
        raise CloudFileError(
            f"{count} {what} in {size} bytes are more than we read, wanted a smaller file or one "
            "with more bytes to each"
        )


def check_surface(vertices: int, triangles: int, size: int, taken: int = 0) -> None:
    """Raises CloudFileError if a mesh, beside `taken` bytes that are held already, is too large for
    a file of `size` bytes."""
    if POINT * vertices + TRIANGLE * triangles + taken > room(size):
        raise CloudFileError(
            f"{vertices} vertices and {triangles} triangles in {size} bytes are more than we read, "
            "wanted a smaller file or one with more bytes to each"
        )


def check_json(text: bytes, size: int) -> None:
    """Raises CloudFileError if the values of a JSON text are too many for a file of `size` bytes.

    They are counted by the marks between them, also those within words.
    """
    # As Python holds them on 64 bits: an array or an object with what is in it at first, an item
    # with its place, and the text itself, whose characters are all as wide as the widest.
    width = 1 if text.isascii() else 4
    objects, arrays = text.count(b"{"), text.count(b"[")
    items = text.count(b",") + objects + arrays
    held = 184 * objects + 88 * arrays + 40 * items + width * len(text)
    if held > room(size):
        raise CloudFileError(
            f"{len(text)} bytes of JSON hold about {items} values, more than we read, wanted "
            "fewer, or a buffer in a file of its own"
        )
