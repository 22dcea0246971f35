"""PCD: text, binary, and compressed binary.

Parsed here: pypcd4, the one kept-up library, trusts the counts of the header, and pulls in
pydantic and a compiled LZF for what is a page of numpy.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

from cfr_jax.io.cloud import CloudFileError, PointCloud, as_float64, cloud_of_filled
from cfr_jax.io.formats.ascii import Lines, clean_text
from cfr_jax.io.formats.lzf import LARGEST_RATIO, decompress

_KINDS = {
    ("F", 4): "<f4", ("F", 8): "<f8",
    ("I", 1): "<i1", ("I", 2): "<i2", ("I", 4): "<i4", ("I", 8): "<i8",
    ("U", 1): "<u1", ("U", 2): "<u2", ("U", 4): "<u4", ("U", 8): "<u8",
}  # fmt: skip
_POINTS = ("x", "y", "z")
_NORMALS = ("normal_x", "normal_y", "normal_z")
_LONGEST_HEADER = 1 << 16
# Of the cloud's extent; no scanner is as precise.
_LARGEST_ROUNDING = 1e-5


@dataclass(frozen=True)
class _Header:
    fields: list[str]
    kinds: list[str]
    repeats: list[int]
    points: int
    storage: str
    body: int
    lines: int

    @property
    def row_size(self) -> int:
        return sum(int(k[2]) * r for k, r in zip(self.kinds, self.repeats, strict=True))


def parse(data: bytes, name: str) -> PointCloud:
    """x, y, z and, if there, normal_x, normal_y, normal_z.

    Rows with a NaN in x, y or z are the empty cells of an organized cloud: they are left out and
    counted in `left_out`. VIEWPOINT is not applied: points stay in the sensor's frame.
    """
    header = _parse_header(data)
    if header.storage == "ascii":
        columns = _read_text(data, header)
    elif header.storage == "binary":
        columns = _read_rows(data, header)
    else:
        columns = _read_compressed(data, header)
    points = np.column_stack([as_float64(columns[axis]) for axis in _POINTS])
    normals = None
    if all(axis in columns for axis in _NORMALS):
        normals = np.column_stack([as_float64(columns[axis]) for axis in _NORMALS])
    return cloud_of_filled(points, normals, name)


def _parse_header(data: bytes) -> _Header:
    entries: dict[str, list[str]] = {}
    offset = lines = 0
    while "DATA" not in entries:
        end = data.find(b"\n", offset, _LONGEST_HEADER)
        if end < 0:
            raise CloudFileError(f"line {lines + 1}: wanted a PCD header with a line DATA")
        line = data[offset:end].decode("latin1")
        offset, lines = end + 1, lines + 1
        key, *values = line.split() or ["#"]
        if key.startswith("#"):
            continue
        if key not in (
            "VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT",
            "POINTS", "DATA",
        ):  # fmt: skip
            raise CloudFileError(
                f"line {lines}: wanted an entry of a PCD header, got {line[:80]!r}"
            )
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
    kinds = [_KINDS.get(pair, "") for pair in zip(entries["TYPE"], sizes, strict=True)]
    if "" in kinds:
        bad = kinds.index("")
        raise CloudFileError(
            f"field {fields[bad]!r}: unknown TYPE {entries['TYPE'][bad]} of SIZE {sizes[bad]}"
        )
    for axis in _POINTS:
        if fields.count(axis) != 1 or repeats[fields.index(axis)] != 1:
            raise CloudFileError(f"FIELDS: wanted {axis!r} once, got {' '.join(fields)[:80]!r}")

    extent = [_integers(key, entries.get(key, ["1"]), 1)[0] for key in ("WIDTH", "HEIGHT")]
    if "POINTS" not in entries and "WIDTH" not in entries:
        raise CloudFileError("the header has no line POINTS")
    points = _integers("POINTS", entries["POINTS"], 1)[0] if "POINTS" in entries else None
    if points is None:
        points = extent[0] * extent[1]
    elif "WIDTH" in entries and extent[0] * extent[1] != points:
        raise CloudFileError(
            f"POINTS is {points}, WIDTH and HEIGHT are {extent[0]} and {extent[1]}"
        )
    storage = entries["DATA"][0]
    if storage not in ("ascii", "binary", "binary_compressed"):
        raise CloudFileError(f"line {lines}: unknown DATA {storage!r}")
    return _Header(fields, kinds, repeats, points, storage, offset, lines)


def _integers(key: str, values: list[str], count: int) -> list[int]:
    good = all(value.isdecimal() and value.isascii() and len(value) < 16 for value in values)
    if not good or len(values) != count:
        got = " ".join(values)[:80]
        raise CloudFileError(f"{key}: wanted {count} non-negative integers, got {got!r}")
    return [int(value) for value in values]


def _read_text(data: bytes, header: _Header) -> dict[str, np.ndarray]:
    lines = Lines(clean_text(data[header.body :]), header.lines + 1)
    table = lines.run(0, header.points, "points").table()
    width = sum(header.repeats)
    if len(table) and table.shape[1] != width:
        raise CloudFileError(
            f"line {header.lines + 1}: wanted {width} numbers per point, got {table.shape[1]}"
        )
    ends = np.cumsum(header.repeats)
    starts = ends - header.repeats
    return {
        label: table[:, start] if len(table) else np.empty(0)
        for label, start, repeat in zip(header.fields, starts, header.repeats, strict=True)
        if repeat == 1
    }


def _read_rows(data: bytes, header: _Header) -> dict[str, np.ndarray]:
    size = header.points * header.row_size
    if header.body + size > len(data):
        raise CloudFileError(
            f"byte {header.body}: {header.points} points of {header.row_size} bytes are {size}, "
            f"the file holds {len(data) - header.body}"
        )
    # Offsets instead of a dtype of all fields: padding is called "_" as often as there is some.
    columns = {}
    offset = 0
    for label, kind, repeat in zip(header.fields, header.kinds, header.repeats, strict=True):
        if repeat == 1:
            columns[label] = np.ndarray(
                header.points, kind, data, header.body + offset, header.row_size
            )
        offset += int(kind[2]) * repeat
    return columns


def _read_compressed(data: bytes, header: _Header) -> dict[str, np.ndarray]:
    """One column after the other, compressed together."""
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
    columns = {}
    offset = 0
    for label, kind, repeat in zip(header.fields, header.kinds, header.repeats, strict=True):
        if repeat == 1:
            columns[label] = np.frombuffer(raw, kind, header.points, offset)
        offset += int(kind[2]) * repeat * header.points
    return columns


def save(stream: BinaryIO, cloud: PointCloud) -> None:
    """Binary float32; a cloud that this would deform is refused.

    The format knows doubles too, but Open3D and PCL read them as zeros without a word.
    """
    extent = np.linalg.norm(np.ptp(cloud.points, axis=0))
    rounding = np.abs(cloud.points).max() * np.finfo(np.float32).eps / 2
    if rounding > _LARGEST_ROUNDING * extent > 0:
        raise CloudFileError(
            f"PCD holds float32, which here moves points by {rounding:.1g} in a cloud "
            f"{extent:.3g} across; wanted .ply, .npy, .npz or .xyz, or points nearer the origin"
        )
    fields, table = list(_POINTS), cloud.points
    if cloud.normals is not None:
        fields += _NORMALS
        table = np.hstack([cloud.points, cloud.normals])
    count, columns = table.shape
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(fields),
        "SIZE" + " 4" * columns,
        "TYPE" + " F" * columns,
        "COUNT" + " 1" * columns,
        f"WIDTH {count}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {count}",
        "DATA binary",
        "",
    ]
    stream.write("\n".join(lines).encode())
    stream.write(table.astype("<f4").tobytes())
