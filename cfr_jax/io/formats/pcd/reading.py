"""PCD: text, binary, and compressed binary.

Read here because pypcd4, the one library that is kept up, trusts the counts of the header, and
needs pydantic and a compiled LZF for what is a page of numpy.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from cfr_jax.io.budget import check_room
from cfr_jax.io.cloud import CloudFileError, PointCloud
from cfr_jax.io.formats.pcd.lzf import LARGEST_RATIO, decompress
from cfr_jax.io.formats.text.lines import Lines, clean_text
from cfr_jax.io.mesh import Mesh
from cfr_jax.io.table import Table, table_of

_KINDS = {
    ("F", 4): "<f4", ("F", 8): "<f8",
    ("I", 1): "<i1", ("I", 2): "<i2", ("I", 4): "<i4", ("I", 8): "<i8",
    ("U", 1): "<u1", ("U", 2): "<u2", ("U", 4): "<u4", ("U", 8): "<u8",
}  # fmt: skip
SOURCE = "PCD"
PADDING = "_"
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


def parse(
    data: bytes, name: str, *, columns: tuple[str, ...] | None = None, whole: bool = False
) -> PointCloud | Mesh:
    """x, y, z and, if there, the normals, which the names of the fields say.

    Rows with NaN in x, y or z are the empty cells of an organized cloud: they are left out and
    counted in `left_out`. VIEWPOINT is not applied: points stay in the frame of the sensor.
    """
    header = _parse_header(data)
    if header.storage == "ascii":
        values = _read_text(data, header)
    elif header.storage == "binary":
        values = _read_rows(data, header)
    else:
        values = _read_compressed(data, header)
    check_room(header.points, 24, len(data), "points")
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
            source=SOURCE,
        )
    except ValueError as error:
        raise CloudFileError(f"FIELDS: {error}") from None


def _parse_header(data: bytes) -> Header:
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
        rows = len(Lines(clean_text(data[body:])))
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


def _read_text(data: bytes, header: Header) -> list[np.ndarray]:
    lines = Lines(clean_text(data[header.body :]), header.lines + 1)
    table = lines.run(0, header.points, "points").table()
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
    if start + packed > len(data) or unpacked != size or size > LARGEST_RATIO * packed:
        raise CloudFileError(
            f"byte {header.body}: {packed} bytes that unfold to {unpacked}, wanted {size} bytes "
            f"({header.points} points) from at most {len(data) - start}"
        )
    raw = decompress(data, start, start + packed, size)
    values = []
    offset = 0
    for kind, repeat in zip(header.kinds, header.repeats, strict=True):
        count = header.points * repeat
        part = np.frombuffer(raw, kind, count, offset)
        values.append(part if repeat == 1 else part.reshape(header.points, repeat))
        offset += np.dtype(kind).itemsize * count
    return values
