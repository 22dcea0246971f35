"""NPY and NPZ arrays, and the bare float32 rows of KITTI's Velodyne scans."""

from __future__ import annotations

import io
import math
import re
import zipfile
from typing import BinaryIO

import numpy as np

from cfr_jax.io.cloud import CloudFileError, PointCloud, cloud_from_table

_DESCR = re.compile(r"""['"]descr['"]\s*:\s*['"]([<>|=]?[A-Za-z]\w*)['"]""")
_ORDER = re.compile(r"""['"]fortran_order['"]\s*:\s*(True|False)\b""")
_SHAPE = re.compile(r"""['"]shape['"]\s*:\s*\(([\d,\s]*)\)""")
_LONGEST_HEADER = 10_000

# What a small archive may unfold to, so that a few kilobytes cannot fill the memory. Coordinates
# do not compress a hundredfold.
_ALWAYS_ALLOWED = 32 << 20
_LARGEST_RATIO = 100


def parse_npy(data: bytes, name: str) -> PointCloud:
    """An (n, 3) array or wider, of any float or integer type; see `cloud_from_table` for six."""
    return cloud_from_table(read_array(data), name)


def read_array(data: bytes) -> np.ndarray:
    """The array of an NPY file.

    Read by hand: `np.load` evaluates the header as a Python literal, and of a damaged one lets
    out a dozen kinds of errors and warnings.
    """
    if data[:6] != b"\x93NUMPY":
        raise CloudFileError(f"byte 0: is {data[:6]!r}, wanted the NPY mark b'\\x93NUMPY'")
    size_bytes = 2 if data[6:7] == b"\x01" else 4
    start = 8 + size_bytes
    length = int.from_bytes(data[8:start], "little")
    if length > _LONGEST_HEADER or start + length > len(data):
        raise CloudFileError(f"byte 8: a header of {length} bytes, the file has {len(data)}")
    header = data[start : start + length].decode("latin1")
    descr, order, shape = (pattern.search(header) for pattern in (_DESCR, _ORDER, _SHAPE))
    if descr is None or order is None or shape is None:
        raise CloudFileError(
            f"byte {start}: wanted a header with descr (a number type), fortran_order and shape, "
            f"got {header.strip()[:80]!r}"
        )
    try:
        dtype = np.dtype(descr[1])
    except TypeError:
        raise CloudFileError(f"byte {start}: unknown number type {descr[1]!r}") from None
    if dtype.kind not in "fiu":
        raise CloudFileError(f"byte {start}: holds {dtype}, wanted floats or integers")
    cells = shape[1].replace(",", " ").split()
    if len(cells) != 2 or max(map(len, cells)) > 18:
        raise CloudFileError(f"byte {start}: the shape is ({shape[1]}), wanted (n, 3) or (n, 6)")
    sizes = tuple(int(cell) for cell in cells)
    start += length
    if math.prod(sizes) * dtype.itemsize != len(data) - start:
        raise CloudFileError(
            f"byte {start}: {sizes} of {dtype} are {math.prod(sizes) * dtype.itemsize} bytes, "
            f"the file holds {len(data) - start}"
        )
    array = np.frombuffer(data, dtype, offset=start)
    return array.reshape(sizes, order="F" if order[1] == "True" else "C")


def parse_npz(data: bytes, name: str) -> PointCloud:
    """The arrays `points` and, if there, `normals`; or the only array, as of an NPY file."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            chosen: list[str] = [key for key in ("points", "normals") if key in members]
            if "points" not in chosen:
                if len(members) != 1:
                    held = ", ".join(map(repr, sorted(members)[:8])) or "nothing"
                    raise CloudFileError(f"wanted an array 'points' or a single one, got {held}")
                chosen = list(members)
            arrays = [_member(archive, members[key], len(data)) for key in chosen]
    except CloudFileError:
        raise
    except Exception as error:  # zipfile and the codecs below it raise what they like
        raise CloudFileError(
            f"wanted a zip archive of arrays: {type(error).__name__}: {error}"
        ) from None
    if len(arrays) == 1:
        return cloud_from_table(arrays[0], name)
    return PointCloud(arrays[0], arrays[1], name)


def _member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, archive_size: int) -> np.ndarray:
    if info.file_size > _ALWAYS_ALLOWED + _LARGEST_RATIO * archive_size:
        raise CloudFileError(
            f"{info.filename!r} unfolds to {info.file_size} bytes, "
            f"more than {_LARGEST_RATIO} times the file"
        )
    with archive.open(info) as stream:
        data = stream.read(info.file_size)
    try:
        return read_array(data)
    except CloudFileError as error:
        raise CloudFileError(f"{info.filename!r}: {error}") from None


def parse_velodyne(data: bytes, name: str) -> PointCloud:
    """Rows of four little-endian float32: x, y, z and a reflectance, which is left out."""
    if len(data) % 16:
        raise CloudFileError(f"has {len(data)} bytes, wanted rows of 16 (four float32)")
    return PointCloud(np.frombuffer(data, "<f4").reshape(-1, 4)[:, :3], None, name)


def save_npy(stream: BinaryIO, cloud: PointCloud) -> None:
    """One float64 array, (n, 3) or with normals (n, 6)."""
    table = cloud.points if cloud.normals is None else np.hstack([cloud.points, cloud.normals])
    np.save(stream, table, allow_pickle=False)


def save_npz(stream: BinaryIO, cloud: PointCloud) -> None:
    """The float64 arrays `points` and, if there are any, `normals`."""
    if cloud.normals is None:
        np.savez(stream, points=cloud.points)
    else:
        np.savez(stream, points=cloud.points, normals=cloud.normals)
