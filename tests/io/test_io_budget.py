"""Files whose rows are short grow in memory: they stay within the budget, or are refused."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
from kind_samples import npy
from test_io_mutations import BYTES, BYTES_PER_BYTE, SECONDS, _memory, _reset_peak

SIZE = 20_000_000  # bytes: where four times the file weigh more than what is always allowed


def dense_files(size: int) -> dict[str, bytes]:
    """Files of about that many bytes with as little as possible to each point or face."""
    third, triangle = size // 3, struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)
    floats = "property float x\nproperty float y\nproperty float z\n"
    faces = f"vertex 3\n{floats}element face {size // 9 * 2}\n"
    faces += "property list uchar uchar vertex_indices\n"
    pcd = f"FIELDS x y z\nSIZE 1 1 1\nTYPE U U U\nPOINTS {third}\nDATA binary\n"
    lists = struct.pack("<3fB", 1, 2, 3, 0) + struct.pack("<3fBH", 1, 2, 4, 1, 5)
    count = size // len(lists)
    names = f"vertex {2 * count}\n{floats}property list uchar ushort seen\n"
    pose = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    facet = b"facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
    facet += b"endloop\nendfacet\n"

    def ply(element: str, body: bytes) -> bytes:
        head = f"ply\nformat binary_little_endian 1.0\nelement {element}end_header\n"
        return head.encode() + body

    return {
        "digits.xyz": b"1 2 3\n" * (size // 6),
        "newlines.txt": b"1 2 3\n" + b"\n" * size,
        "comments.txt": b"1 2 3\n" + b"#\n" * (size // 8),
        "one line.asc": b"1 " * (size // 2),
        "one cell.xyz": b"1 2 3\n4 5 " + b"1" * size,
        "words.csv": b"x,y,z,w\n" + b"1,2,3,a\n" * (size // 8),
        "points.pts": b"1 2 3\n" * (size // 6),
        "grid.ptx": f"{size // 8}\n1\n{pose}".encode() + b"1 2 3 4\n" * (size // 8),
        "wide.csv": ("x,y,z\n" + "1,2,3\n" * (size // 12)).encode("utf-16"),
        "bytes.ply": ply(f"vertex {third}\n{floats.replace('float', 'uchar')}", b"\1\2\3" * third),
        "faces.ply": ply(faces, triangle + b"\3\0\1\2\4\0\1\2\0" * (size // 9)),
        "polygon.ply": ply(
            faces.replace(f"face {size // 9 * 2}", "face 1").replace("list uchar", "list uint"),
            triangle + struct.pack("<I", size) + b"\0\1\2\0" * (size // 4),
        ),
        "lists.ply": ply(names, lists * count),
        "bytes.pcd": pcd.encode() + b"\1\2\3" * third,
        "bytes.npy": npy(np.ones((third, 3), "i1")),
        "solids.stl": (b"solid a\n" + facet + b"endsolid a\n") * (size // 160),
    }


def run_cases() -> list[str]:
    """What was wrong about reading each of them, bare and with all properties."""
    from cfr_jax.io import CloudFileError, read

    warnings.simplefilter("ignore")
    failures = []
    with tempfile.TemporaryDirectory() as folder:
        small = dense_files(2_000)
        for name, data in dense_files(SIZE).items():
            path, warm = Path(folder) / name, Path(folder) / f"small {name}"
            path.write_bytes(data)
            warm.write_bytes(small[name])
            size = len(data)
            del data
            for whole in (False, True):
                before = 0
                for each in (warm, path):  # what is loaded only once is no cost of a case
                    before, start = _reset_peak(), time.process_time()
                    try:
                        read(each, properties=whole)
                    except CloudFileError:
                        pass
                seconds, grown = time.process_time() - start, _memory("VmHWM") - before
                if grown > BYTES + BYTES_PER_BYTE * size:
                    failures.append(f"{name}, whole={whole}: {grown >> 20} MiB for {size >> 20}")
                if seconds > SECONDS * size / 1e7:
                    failures.append(f"{name}, whole={whole}: {seconds:.1f} s for {size >> 20} MiB")
            path.unlink()
    return failures


def test_dense_files_stay_within_four_times_their_size_and_a_second_for_ten_megabytes():
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}

    child = subprocess.run(
        [sys.executable, __file__], capture_output=True, text=True, timeout=300, env=environment
    )

    assert child.returncode == 0, child.stderr[-2000:]
    assert json.loads(child.stdout) == []


if __name__ == "__main__":
    print(json.dumps(run_cases()))
