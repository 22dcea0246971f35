"""PTS and PTX, the text formats of Leica's scanners."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from cfr_jax.io.budget import POINT, check_room
from cfr_jax.io.cloud import CloudFileError, PointCloud
from cfr_jax.io.formats.text.body import read_numbers
from cfr_jax.io.formats.text.dialect import decoded, layout_of
from cfr_jax.io.formats.text.table import parsed
from cfr_jax.io.mesh import Mesh
from cfr_jax.io.table import table_of

_COLORS = ("red", "green", "blue")
# What the columns mean, by their number.
_NAMES = {
    3: ("x", "y", "z"),
    4: ("x", "y", "z", "intensity"),
    6: ("x", "y", "z", *_COLORS),
    7: ("x", "y", "z", "intensity", *_COLORS),
}
_PTX_HEADER = 10
# How many scans there may be; each takes time, however few points it has.
_SCANS, _BYTES_OF_A_SCAN = 500, 20_000


def parse_pts(
    data: bytes, name: str, *, columns: tuple[str, ...] | None = None, whole: bool = False
) -> PointCloud | Mesh:
    """The count of points, then a line for each: x y z, and perhaps intensity and color."""
    text = decoded(data)
    layout = layout_of(text, columns)
    if columns is None and layout.names is None:
        columns = _NAMES.get(layout.width)
    return parsed(text, layout, name, columns, whole)


def parse_ptx(
    data: bytes, name: str, *, columns: tuple[str, ...] | None = None, whole: bool = False
) -> PointCloud | Mesh:
    """One scan or several, each moved by the matrix in its header into the common frame.

    Points at 0 0 0 of the scanner's frame are cells without a return: they are left out and
    counted, as NaN would be.
    """
    if columns is not None:
        raise CloudFileError("columns: PTX files say themselves what they hold")
    text = decoded(data).replace(b"\r\n", b"\n")
    parts: list[np.ndarray] = []
    offset, line = 0, 1
    taken = 0
    while text[offset : offset + 4096].strip():
        part, offset, line = _scan(text, offset, line, taken)
        parts.append(part)
        taken += len(part)
        if len(parts) > _SCANS + len(text) // _BYTES_OF_A_SCAN:
            raise CloudFileError(f"line {line}: more than {len(parts)} scans of a few points each")
        if part.shape[1] != parts[0].shape[1]:
            raise CloudFileError(
                f"line {line}: a scan of {part.shape[1]} columns after one of {parts[0].shape[1]}"
            )
    if not parts:
        raise CloudFileError("holds no scan, wanted a header of ten lines and points")
    rows = parts[0] if len(parts) == 1 else np.concatenate(parts)
    names = _NAMES.get(rows.shape[1])
    if names is None:
        raise CloudFileError(f"has rows of {rows.shape[1]} numbers, wanted 3, 4, 6 or 7")
    return table_of(names, list(rows.T), format="PTX").shape(name, (), whole)


def _scan(
    text: bytes, offset: int, line: int, taken: int
) -> tuple[Float64[np.ndarray, "n c"], int, int]:
    """The rows of a scan, and the offset and the number of the line behind it; `taken` rows came
    before."""
    header: list[list[float]] = []
    for _ in range(_PTX_HEADER):
        end = text.find(b"\n", offset)
        if end < 0:
            raise CloudFileError(f"line {line}: the file ends within the header of a scan")
        try:
            header.append([float(word) for word in text[offset:end].split()])
        except ValueError:
            header.append([])
        offset, line = end + 1, line + 1
    sizes = [len(numbers) for numbers in header]
    grid = [numbers[0] for numbers in header[:2] if numbers]
    if sizes != [1, 1, 3, 3, 3, 3, 4, 4, 4, 4] or not all(
        0 <= n < 2**31 and n % 1 == 0 for n in grid
    ):
        raise CloudFileError(
            f"line {line - _PTX_HEADER}: wanted a header of ten lines: two counts, four lines of "
            "three numbers, and a matrix of four lines"
        )
    count = int(grid[0] * grid[1])
    end = _behind_lines(text, offset, count)
    body = text[offset:end]
    if count == 0 or body.count(b"\n") + (not body.endswith(b"\n")) < count:
        raise CloudFileError(f"line {line}: wanted {count} points, the file holds fewer")
    layout = replace(layout_of(body, ("x", "y", "z")), line=line)
    # placed, joined, and as a cloud
    check_room(taken + count, 8 * layout.width + 2 * POINT, len(text), "points")
    rows = read_numbers(body, layout, None)
    if len(rows) != count or rows.shape[1] < 3:
        raise CloudFileError(f"line {line}: wanted {count} points, got {len(rows)}")
    empty = (rows[:, :3] == 0).all(axis=1)
    matrix = np.array(header[6:])  # of row vectors: its last row is the translation
    with np.errstate(all="ignore"):  # what is not finite is left out or refused later on
        rows[:, :3] = rows[:, :3] @ matrix[:3, :3] + matrix[3, :3]
    rows[empty, :3] = np.nan
    return rows, end, line + count


def _behind_lines(text: bytes, offset: int, count: int) -> int:
    """The offset behind that many lines, or the end."""
    step = 1 << 20
    while offset < len(text):
        newlines = text.count(b"\n", offset, offset + step)
        if newlines >= count:
            break
        count -= newlines
        offset += step
    for _ in range(count):
        end = text.find(b"\n", offset)
        if end < 0:
            return len(text)
        offset = end + 1
    return min(offset, len(text))
