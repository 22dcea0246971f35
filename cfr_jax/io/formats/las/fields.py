"""What a point of LAS holds beside its coordinates, by the number of the point format."""

from __future__ import annotations

import struct

import numpy as np

_FIRST = [
    ("X", "<i4"), ("Y", "<i4"), ("Z", "<i4"), ("intensity", "<u2"),
]  # fmt: skip
_OLD: list[tuple[str, str]] = [
    *_FIRST, ("bits", "u1"), ("classes", "u1"), ("scan_angle_rank", "i1"), ("user_data", "u1"),
    ("point_source_id", "<u2"),
]  # fmt: skip
_NEW = [
    *_FIRST, ("bits", "u1"), ("flags", "u1"), ("classification", "u1"), ("user_data", "u1"),
    ("scan_angle", "<i2"), ("point_source_id", "<u2"), ("gps_time", "<f8"),
]  # fmt: skip
_TIME = [("gps_time", "<f8")]
_COLOR = [("red", "<u2"), ("green", "<u2"), ("blue", "<u2")]
_INFRARED = [("nir", "<u2")]
_WAVE = [
    ("wavepacket_index", "u1"), ("wavepacket_offset", "<u8"), ("wavepacket_size", "<u4"),
    ("return_point_wave_location", "<f4"), ("x_t", "<f4"), ("y_t", "<f4"), ("z_t", "<f4"),
]  # fmt: skip
_LAYOUTS = (
    _OLD, _OLD + _TIME, _OLD + _COLOR, _OLD + _TIME + _COLOR, _OLD + _TIME + _WAVE,
    _OLD + _TIME + _COLOR + _WAVE,
    _NEW, _NEW + _COLOR, _NEW + _COLOR + _INFRARED, _NEW + _WAVE, _NEW + _COLOR + _INFRARED + _WAVE,
)  # fmt: skip
# Of each field that is cut into bits: names, first bit, and how many.
_BITS = {
    False: {
        "bits": [("return_number", 0, 3), ("number_of_returns", 3, 3),
                 ("scan_direction_flag", 6, 1), ("edge_of_flight_line", 7, 1)],
        "classes": [("classification", 0, 5), ("synthetic", 5, 1), ("key_point", 6, 1),
                    ("withheld", 7, 1)],
    },
    True: {
        "bits": [("return_number", 0, 4), ("number_of_returns", 4, 4)],
        "flags": [("synthetic", 0, 1), ("key_point", 1, 1), ("withheld", 2, 1), ("overlap", 3, 1),
                  ("scanner_channel", 4, 2), ("scan_direction_flag", 6, 1),
                  ("edge_of_flight_line", 7, 1)],
    },
}  # fmt: skip
_EXTRA_TYPES = (
    "", "u1", "i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f4", "<f8",
)  # fmt: skip
_EXTRA_RECORD = 192


def properties(
    rows: np.ndarray, layout: int, described: bytes
) -> tuple[list[str], list[np.ndarray]]:
    """Names and values of all fields but X, Y, Z of points, given as rows of bytes.

    Names are those of laspy. `described` is the record that names bytes which a file adds to its
    points.
    """
    fields = _LAYOUTS[layout]
    widths = [np.dtype(kind).itemsize for _, kind in fields]
    size = sum(widths)
    names: list[str] = []
    values: list[np.ndarray] = []
    cut = _BITS[layout >= 6]
    dtype = np.dtype(  # type: ignore[call-overload]
        {
            "names": [name for name, _ in fields],
            "formats": [kind for _, kind in fields],
            "offsets": np.cumsum([0, *widths])[:-1],
            "itemsize": rows.shape[1],
        }
    )
    whole = np.ascontiguousarray(rows).view(dtype)[:, 0]
    for name, _ in fields[3:]:
        if name not in cut:
            names.append(name)
            values.append(whole[name])
            continue
        for part, first, count in cut[name]:
            names.append(part)
            values.append((whole[name] >> first) & ((1 << count) - 1))
    extra = rows[:, size:]
    for name, kind in _extra_fields(described):
        width = np.dtype(kind).itemsize
        if width > extra.shape[1]:
            break
        names.append(name)
        values.append(np.ascontiguousarray(extra[:, :width]).view(kind)[:, 0])
        extra = extra[:, width:]
    if extra.shape[1]:
        names.append("extra_bytes")
        values.append(extra)
    return names, values


def _extra_fields(described: bytes) -> list[tuple[str, str]]:
    """The names and types of added fields, up to the first of a type we do not know."""
    fields = []
    for at in range(0, len(described) - _EXTRA_RECORD + 1, _EXTRA_RECORD):
        (kind,) = struct.unpack_from("B", described, at + 2)
        name = described[at + 4 : at + 36].split(b"\0")[0].decode("utf-8", "replace")
        if not 0 < kind < len(_EXTRA_TYPES):
            break
        fields.append((name or "extra", _EXTRA_TYPES[kind]))
    return fields
