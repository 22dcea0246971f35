"""Records as lines of JSON, each with a checksum, so that a changed or damaged line is noticed."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cfr_jax.runtime.messages import Refused, shown
from cfr_jax.runtime.reading import opened, parse_json

_CHECK = 16  # hexadecimal digits
_END = re.compile(rb', "check": "([0-9a-f]{%d})"}\n' % _CHECK)
_END_SIZE = len(', "check": ""}\n') + _CHECK
# Bytes; a record has a few thousand. Parsed JSON can take many times the memory of its text.
_LONGEST_LINE = 1 << 22


def line_of(value: dict[str, Any]) -> bytes:
    """A record as a line of a journal. Its last member, `check`, is the start of the SHA-256 of the
    line without it."""
    bare = json.dumps(value, allow_nan=False).encode()
    return bare[:-1] + f', "check": "{_check(bare)}"}}\n'.encode()


def record_at(path: Path, start: int) -> dict[str, Any]:
    """The record whose line starts at this byte; raises ValueError if the line was changed."""
    with opened(path) as stream:
        stream.seek(start)
        return _record(stream.readline(_LONGEST_LINE), f"{shown(path)}, byte {start}")


def records_in(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """Each record, the header first, with the byte where its line starts.

    Ends before a line that is still being written, and before a header that is damaged. Raises
    ValueError for any other line that is damaged.
    """
    with opened(path) as stream:
        start, number = 0, 0
        while line := stream.readline(_LONGEST_LINE):
            if not line.endswith(b"\n") and len(line) < _LONGEST_LINE:
                return  # still being written, by another shard
            number += 1
            try:
                yield start, _record(line, f"{shown(path)}, line {number}", header=number == 1)
            except Refused:
                if number == 1:
                    return
                raise
            start += len(line)


def _record(line: bytes, where: str, header: bool = False) -> dict[str, Any]:
    """The value of a line whose checksum fits."""
    try:
        end = _END.fullmatch(line[-_END_SIZE:])
        bare = memoryview(line)[:-_END_SIZE]  # a line may be long, and is not copied
        if end is None or _check(bare, b"}").encode() != end[1]:
            if header and line.startswith(b'{"format": "cfr_jax/batch/1"'):
                return parse_json(line)  # of the version without checksums
            raise Refused("its checksum does not fit")
        record = parse_json(line)
        if not header and not _is_record(record):
            raise Refused("it is not a record of a pair")
    except Refused as error:
        raise Refused(
            f"{where} is damaged ({error}): remove the line, and its pair is registered again"
        ) from None
    return record


def _is_record(value: Any) -> bool:
    return (
        isinstance(value, dict)
        and all(isinstance(value.get(name), str) for name in ("source", "target"))
        and isinstance(value.get("repeat"), int)
        and isinstance(value.get("error", 0), str | None)
    )


def _check(*parts: bytes | memoryview) -> str:
    """The start of the SHA-256 of a line in one or more parts."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    return digest.hexdigest()[:_CHECK]
