"""Tables as text: every number with the digits that its type needs, and whole numbers as such."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from typing import BinaryIO

import numpy as np

from cfr_jax.io.cloud import PointCloud
from cfr_jax.io.table import Table, plain_table, without_faces

_ROWS_AT_ONCE = 1 << 14


def save(stream: BinaryIO, cloud: PointCloud) -> list[str]:
    """Columns separated by blanks; their names, if there are any, in a comment above."""
    table, notes = without_faces(cloud, "text")
    flat = _flat(table)
    if any(values.dtype.kind in "US" for _, values in flat):
        spaced = [name for name, values in flat if _has_blanks(values)]
        if spaced:
            notes.append(f"left out {', '.join(spaced)}: text with blanks, which .csv can hold")
            flat = [(name, values) for name, values in flat if name not in spaced]
    if table.named and not (table.is_bare and table.format != "text"):
        names = [name.replace(" ", "_") for name, _ in flat]
        stream.write(("# " + " ".join(names) + "\n").encode())
    _write_rows(stream, [values for _, values in flat], " ")
    return notes


def save_csv(stream: BinaryIO, cloud: PointCloud) -> list[str]:
    """Columns separated by commas, below a line of their names."""
    table, notes = without_faces(cloud, "CSV")
    flat = _flat(table if cloud.table is not None else plain_table(cloud))
    names = [name for name, _ in flat]
    if table.named or cloud.table is None:
        stream.write(_csv_line(names))
    _write_rows(stream, [values for _, values in flat], ",")
    return notes


def _flat(table: Table) -> list[tuple[str, np.ndarray]]:
    """One column for each number of a row."""
    flat = []
    for name, values in zip(table.names, table.values, strict=True):
        if values.ndim == 1:
            flat.append((name, values))
        elif len(table.roles.points) == 1 and name == table.names[table.roles.points[0]]:
            flat += [(axis, values[:, k]) for k, axis in enumerate("xyz")]
        elif len(table.roles.normals) == 1 and name == table.names[table.roles.normals[0]]:
            flat += [("n" + axis, values[:, k]) for k, axis in enumerate("xyz")]
        else:
            flat += [(f"{name}_{k}", values[:, k]) for k in range(values.shape[1])]
    return flat


def _has_blanks(values: np.ndarray) -> bool:
    return values.dtype.kind in "US" and any(
        not str(cell) or any(mark in str(cell) for mark in ' \t"#') for cell in values
    )


def _csv_line(cells: list[str]) -> bytes:
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow(cells)
    return line.getvalue().encode()


def _write_rows(stream: BinaryIO, columns: list[np.ndarray], delimiter: str) -> None:
    ways = [_way(values) for values in columns]
    for start in range(0, len(columns[0]) if columns else 0, _ROWS_AT_ONCE):
        cells = [
            way(values[start : start + _ROWS_AT_ONCE])
            for way, values in zip(ways, columns, strict=True)
        ]
        lines = map(delimiter.join, zip(*cells, strict=True))
        stream.write(("\n".join(lines) + "\n").encode())


def _way(values: np.ndarray) -> Callable[[np.ndarray], list[str]]:
    """How the cells of a column are written; what is read back is the same number."""
    match values.dtype.kind:
        case "f" if values.dtype.itemsize < 8:
            # the shortest digits that give the same number of this very type
            return lambda part: [str(v) for v in part]
        case "b":
            return lambda part: [str(int(v)) for v in part]
        case "U" | "S":
            return lambda part: [_quoted(v) for v in part]
        case _:
            return lambda part: list(map(repr, part.tolist()))


def _quoted(cell: object) -> str:
    text = cell.decode("utf-8", "replace") if isinstance(cell, bytes) else str(cell)
    if any(mark in text for mark in ',;"\n\r') or text != text.strip():
        return '"' + text.replace('"', '""') + '"'
    return text
