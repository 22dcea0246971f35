"""A SHA-256 in front of a file's content, so that a flipped bit is noticed before it is believed.

A sealed file is 32 bytes of digest, and then the content. This finds accidents; it proves nothing
about who wrote the file.
"""

from __future__ import annotations

import hashlib

SIZE = 32  # bytes of the digest


def sealed(content: bytes) -> bytes:
    """The content with its digest in front."""
    return hashlib.sha256(content).digest() + content


def unsealed(data: bytes) -> bytes | None:
    """The content of a sealed file, or None if it is not what was sealed."""
    told, content = data[:SIZE], data[SIZE:]
    return content if told == hashlib.sha256(content).digest() else None
