"""XYZ, TXT and CSV: a point per line, its numbers apart by blanks or by commas."""

from __future__ import annotations

import re
from typing import BinaryIO

import numpy as np

from cfr_jax.io.cloud import CloudFileError, PointCloud, cloud_from_table
from cfr_jax.io.formats.ascii import Lines, clean_text

_COMMENT = re.compile(rb"(#|//)[^\n]*")
_POINT_NAMES = ("x", "y", "z")
_NORMAL_NAMES = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))


def parse(data: bytes, name: str) -> PointCloud:
    """Three columns or more, the first three x, y, z; see `cloud_from_table` for six.

    `#` and `//` start comments. A first line of names, as CSV files have it, says which columns
    are x, y, z (and nx, ny, nz); then the others need not be numbers.
    """
    lines = Lines(_COMMENT.sub(b"", clean_text(data)))
    if len(lines) == 0:
        raise CloudFileError("holds no points, wanted a line of x, y, z at least")
    head = lines.run(0, 1, "lines").data.strip()
    delimiter = next((mark for mark in (",", ";") if mark.encode() in head), None)
    names = [cell.strip().strip(b'"').decode("latin1").lower() for cell in _split(head, delimiter)]
    if not set(_POINT_NAMES) <= set(names):
        return cloud_from_table(lines.table(delimiter=delimiter), name)

    wanted = next((w for w in _NORMAL_NAMES if set(w) <= set(names)), ())
    columns = tuple(names.index(column) for column in (*_POINT_NAMES, *wanted))
    body = lines.run(1, len(lines) - 1, "lines")
    if len(body) == 0:
        raise CloudFileError("holds no points below its line of names, wanted one at least")
    return cloud_from_table(body.table(delimiter=delimiter, columns=columns), name)


def _split(line: bytes, delimiter: str | None) -> list[bytes]:
    return line.split(None if delimiter is None else delimiter.encode())


def save(stream: BinaryIO, cloud: PointCloud) -> None:
    """x y z and, if there are normals, nx ny nz, with the digits that float64 needs."""
    table = cloud.points if cloud.normals is None else np.hstack([cloud.points, cloud.normals])
    np.savetxt(stream, table, fmt="%s")
