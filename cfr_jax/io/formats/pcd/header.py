"""The header of a PCD file."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from cfr_jax.io.cloud import CloudFileError
from cfr_jax.io.formats.text.lines import Text, clean_text

_KINDS = {
    ("F", 4): "<f4", ("F", 8): "<f8",
    ("I", 1): "<i1", ("I", 2): "<i2", ("I", 4): "<i4", ("I", 8): "<i8",
    ("U", 1): "<u1", ("U", 2): "<u2", ("U", 4): "<u4", ("U", 8): "<u8",
}  # fmt: skip
_LONGEST_HEADER = 1 << 16
_KNOWN = (
    "VERSION", "FIELDS", "COLUMNS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT",
    "POINTS", "DATA",
)  # fmt: skip


@dataclass(frozen=True)
class Header:
    """What stands above the points."""

    fields: list[str]
    kinds: list[str]
    repeats: list[int]
    points: int
    storage: str
    body: int
    lines: int
    entries: dict[str, list[str]]

    @property
    def row_size(self) -> int:
        """Bytes of a point."""
        return row_size(self.kinds, self.repeats)


def parse_header(data: bytes) -> Header:
    """The header at the start of a file; raises CloudFileError with the line that is wrong."""
    entries: dict[str, list[str]] = {}
    offset = lines = 0
    while "DATA" not in entries:
        end = data.find(b"\n", offset, _LONGEST_HEADER)
        if end < 0:
            raise CloudFileError(f"line {lines + 1}: wanted a PCD header with a line DATA")
        line = data[offset:end].decode("latin1").removeprefix("\xef\xbb\xbf")
        offset, lines = end + 1, lines + 1
        key, *values = line.split() or ["#"]
        key = key.upper()
        if key.startswith("#"):
            continue
        if key not in _KNOWN:
            if not key.isidentifier() or not line.isprintable():
                raise CloudFileError(
                    f"line {lines}: wanted an entry of a PCD header, got {line[:80]!r}"
                )
            continue  # programs add entries of their own
        key = "FIELDS" if key == "COLUMNS" else key  # as in version 0.5
        if key in entries or not values:
            raise CloudFileError(f"line {lines}: wanted one line {key} with values")
        entries[key] = values

    for key in ("FIELDS", "SIZE", "TYPE"):
        if key not in entries:
            raise CloudFileError(f"the header has no line {key}")
    fields = entries["FIELDS"]
    sizes = _integers("SIZE", entries["SIZE"], len(fields))
    repeats = _integers("COUNT", entries.get("COUNT", ["1"] * len(fields)), len(fields))
    if len(entries["TYPE"]) != len(fields):
        raise CloudFileError(f"TYPE: wanted {len(fields)} values, got {len(entries['TYPE'])}")
    types = [kind.upper() for kind in entries["TYPE"]]
    kinds = [_KINDS.get(pair, "") for pair in zip(types, sizes, strict=True)]
    if "" in kinds:
        bad = kinds.index("")
        raise CloudFileError(
            f"field {fields[bad]!r}: unknown TYPE {entries['TYPE'][bad]} of SIZE {sizes[bad]}"
        )
    extent = [_integers(key, entries.get(key, ["1"]), 1)[0] for key in ("WIDTH", "HEIGHT")]
    if "POINTS" not in entries and "WIDTH" not in entries:
        raise CloudFileError("the header has no line POINTS")
    points = _integers("POINTS", entries["POINTS"], 1)[0] if "POINTS" in entries else None
    if points is None:
        points = extent[0] * extent[1]
    elif "WIDTH" in entries and extent[0] * extent[1] != points:
        # Programs that thin a cloud forget to change one of them: the body tells which is right.
        points = _points_that_fit(
            data, offset, entries, [points, extent[0] * extent[1]], kinds, repeats
        )
    storage = entries["DATA"][0].lower()
    if storage not in ("ascii", "binary", "binary_compressed"):
        raise CloudFileError(f"line {lines}: unknown DATA {storage!r}")
    return Header(fields, kinds, repeats, points, storage, offset, lines, entries)


def _points_that_fit(
    data: bytes,
    body: int,
    entries: dict[str, list[str]],
    counts: list[int],
    kinds: list[str],
    repeats: list[int],
) -> int:
    """Of the two numbers of points in a header, the one that the body has."""
    storage = entries["DATA"][0].lower()
    if storage == "ascii":
        rows = Text(clean_text(data), body).left()
    else:
        size = row_size(kinds, repeats)
        held = len(data) - body
        if storage == "binary_compressed" and held >= 8:
            held = struct.unpack_from("<I", data, body + 4)[0]
        rows = held // size if size else 0
    if rows in counts:
        return rows
    raise CloudFileError(
        f"POINTS is {counts[0]}, WIDTH x HEIGHT is {counts[1]}, and the file holds {rows}"
    )


def row_size(kinds: list[str], repeats: list[int]) -> int:
    """Bytes of a point."""
    return sum(np.dtype(kind).itemsize * n for kind, n in zip(kinds, repeats, strict=True))


def _integers(key: str, values: list[str], count: int) -> list[int]:
    good = all(value.isdecimal() and value.isascii() and len(value) < 16 for value in values)
    if not good or len(values) != count:
        got = " ".join(values)[:80]
        raise CloudFileError(f"{key}: wanted {count} non-negative integers, got {got!r}")
    return [int(value) for value in values]
