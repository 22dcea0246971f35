"""Files that grow when they are read: as little as possible to each point, face, node or number.

Each maker gives a file of about `size` bytes from a seeded generator, which draws what may vary.
What is compressed is measured by what it unfolds to instead: counts around what is just allowed.
"""

from __future__ import annotations

import io
import random
import struct
import zlib
from collections.abc import Callable

import numpy as np
from amplifying_meshes import mesh_makers
from game_samples import game_makers
from kind_samples import npy

Maker = Callable[[int, random.Random], bytes]
_UNFOLDED = 40 << 20  # bytes, near what small files may become
_PLY_TYPES = {"char": "i1", "uchar": "u1", "short": "<i2", "float": "<f4"}
_TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()


def makers() -> dict[str, Maker]:
    """All kinds of files that grow, by file names."""
    return {
        "digits.xyz": digits,
        "newlines.txt": lambda size, rng: b"1 2 3\n" + rng.choice((b"\n", b" \n", b"\r\n")) * size,
        "comments.txt": lambda size, rng: b"1 2 3\n" + b"#\n" * (size // 2),
        "one line.asc": lambda size, rng: rng.choice((b"1 ", b"1,", b"1;")) * (size // 2),
        "one cell.xyz": lambda size, rng: b"1 2 3\n4 5 " + b"1" * size,
        "words.csv": words,
        "wide.csv": lambda size, rng: ("x,y,z\n" + "1,2,3\n" * (size // 12)).encode("utf-16"),
        "points.pts": lambda size, rng: b"1 2 3\n" * (size // 6),
        "grid.ptx": ptx,
        "scans.ptx": lambda size, rng: ptx(24, rng) * (size // 80),
        "bytes.ply": ply_bytes,
        "short faces.ply": ply_faces,
        "polygon.ply": ply_polygon,
        "lists.ply": ply_lists,
        "short lists.ply": ply_short_lists,
        "text faces.ply": ply_text,
        "bytes.pcd": pcd_bytes,
        "digits.pcd": pcd_text,
        "compressed.pcd": pcd_compressed,
        "repeats.pcd": pcd_repeats,
        "bytes.npy": npy_bytes,
        "halves.npy": lambda size, rng: npy(np.ones((size // 6, 3), "<f2")),
        "deflated.npz": npz_deflated,
        "members.npz": npz_members,
        "overlapping.npz": npz_overlapping,
        "line.laz": laz,
        "wide line.laz": lambda size, rng: laz(size, rng, extra=rng.choice((2, 8))),
        "short rows.las": las,
        **mesh_makers(),
        **game_makers(),
        "scan.bin": lambda size, rng: np.ones((size // 16, 4), "<f4").tobytes(),
    }  # fmt: skip


def digits(size: int, rng: random.Random) -> bytes:
    width = rng.choice((3, 4, 6))
    row = rng.choice((b" ", b",", b"\t")).join([b"%d" % k for k in range(1, width + 1)]) + b"\n"
    return row * (size // len(row))


def words(size: int, rng: random.Random) -> bytes:
    more = rng.choice((b"a", b'""', b"1.5"))
    return b"x,y,z,w\n" + b"1,2,3,%s\n" % more * (size // (7 + len(more)))


def ptx(size: int, rng: random.Random) -> bytes:
    pose = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    return f"{size // 8}\n1\n{pose}".encode() + b"1 2 3 4\n" * (size // 8)


def ply(elements: str, body: bytes, form: str = "binary_little_endian") -> bytes:
    return f"ply\nformat {form} 1.0\n{elements}end_header\n".encode() + body


def _vertex(count: int, kind: str = "float") -> str:
    return f"element vertex {count}\n" + "".join(f"property {kind} {axis}\n" for axis in "xyz")


def ply_bytes(size: int, rng: random.Random) -> bytes:
    kind = rng.choice(("char", "uchar", "short"))
    rows = np.ones(size // np.dtype(_PLY_TYPES[kind]).itemsize // 3 * 3, _PLY_TYPES[kind])
    return ply(_vertex(len(rows) // 3, kind), rows.tobytes())


def ply_faces(size: int, rng: random.Random) -> bytes:
    """Faces of few bytes, some of them of other lengths."""
    kinds = rng.choice(("uchar uchar", "uchar ushort"))
    index = {"uchar uchar": "B", "uchar ushort": "H"}[kinds]
    faces = [struct.pack(f"<B{n}{index}", n, *range(n)) for n in rng.choice(((3, 2), (3, 0), (1,)))]
    faces += [struct.pack(f"<B3{index}", 3, 0, 1, 2)]
    count = size // len(b"".join(faces))
    head = _vertex(3) + f"element face {count * len(faces)}\n"
    head += f"property list {kinds} vertex_indices\n"
    return ply(head, _TRIANGLE + b"".join(faces) * count)


def ply_polygon(size: int, rng: random.Random) -> bytes:
    kind, width = rng.choice((("uchar", 1), ("ushort", 2), ("uint", 4)))
    count = size // width
    head = _vertex(3) + f"element face 1\nproperty list uint {kind} vertex_indices\n"
    corners = (np.arange(count) % 3).astype(f"<u{width}").tobytes()
    return ply(head, _TRIANGLE + struct.pack("<I", count) + corners)


def ply_lists(size: int, rng: random.Random) -> bytes:
    """Vertices with a list that differs in length."""
    rows = struct.pack("<3fB", 1, 2, 3, 0) + struct.pack("<3fBH", 1, 2, 4, 1, 5)
    count = size // len(rows)
    return ply(_vertex(2 * count) + "property list uchar ushort seen\n", rows * count)


def ply_short_lists(size: int, rng: random.Random) -> bytes:
    """An element that nobody needs, of rows of one byte each and some longer ones."""
    each = rng.choice((b"\0", b"\0\0\0\1\5"))
    rows = each.count(b"\0") + each.count(b"\1")
    count = size // len(each)
    head = f"element other {rows * count + 1}\nproperty list uchar uchar few\n"
    return ply(head + _vertex(1), each * count + b"\2\1\1" + _TRIANGLE[:12])


def ply_text(size: int, rng: random.Random) -> bytes:
    face = rng.choice((b"3 0 1 2\n", b"0\n", b"1 0\n"))
    count = size // len(face)
    head = _vertex(3) + f"element face {count}\nproperty list uchar int vertex_indices\n"
    return ply(head, b"0 0 0\n1 0 0\n0 1 0\n" + face * count, "ascii")


def pcd(fields: str, kind: str, count: int, storage: str) -> bytes:
    names = fields.split()
    lines = [f"FIELDS {fields}"]
    lines += [f"{key} {' '.join([value] * len(names))}" for key, value in
              (("SIZE", kind[1]), ("TYPE", kind[0]))]  # fmt: skip
    return "\n".join([*lines, f"POINTS {count}", f"DATA {storage}", ""]).encode()


def pcd_bytes(size: int, rng: random.Random) -> bytes:
    kind = rng.choice(("U1", "I1", "U2"))
    count = size // (3 * int(kind[1]))
    return pcd("x y z", kind, count, "binary") + bytes(3 * int(kind[1]) * count)


def pcd_text(size: int, rng: random.Random) -> bytes:
    return pcd("x y z", "F4", size // 6, "ascii") + b"1 2 3\n" * (size // 6)


def pcd_compressed(size: int, rng: random.Random) -> bytes:
    """Fields of a byte, of about as many points as a small file may hold."""
    fields = rng.choice(("x y z", "x y z a b c d e f"))
    count = int(rng.uniform(0.3, 2) * _UNFOLDED / 24)
    raw = len(fields.split()) * count
    # A zero, then repetitions of 264 bytes from one byte before.
    full, rest = divmod(raw - 1, 264)
    packed = b"\0\0" + b"\xe0\xff\0" * full + b"\0\0" * rest
    head = pcd(fields, "U1", count, "binary_compressed")
    return head + struct.pack("<II", len(packed), raw) + packed


def pcd_repeats(size: int, rng: random.Random) -> bytes:
    """As many instructions as possible: literals of one byte, or repetitions of three."""
    unit, gives = rng.choice(((b"\0\1", 1), (b"\x20\0", 3)))
    count = (size // 2 * gives) // 12
    packed = b"\0\0" + unit * ((12 * count - 1) // gives)
    packed += b"\0\0" * ((12 * count - 1) % gives)
    head = pcd("x y z", "F4", count, "binary_compressed")
    return head + struct.pack("<II", len(packed), 12 * count) + packed


def npy_bytes(size: int, rng: random.Random) -> bytes:
    kind = rng.choice(("i1", "u1", "<i2"))
    width = rng.choice((3, 4, 6))
    rows = size // (width * np.dtype(kind).itemsize)
    array = np.ones((rows, width), kind)
    form = rng.choice(("plain", "fortran", "fields"))
    if form == "fortran":
        array = np.asfortranarray(array)
    elif form == "fields":
        array = np.ones(rows, [(name, kind) for name in "xyzabc"[:width]])
    return npy(array)


def npz_deflated(size: int, rng: random.Random) -> bytes:
    count = int(rng.uniform(0.3, 2) * _UNFOLDED / 24)
    stream = io.BytesIO()
    kind = rng.choice(("i1", "<i2", "<f4"))
    np.savez_compressed(stream, points=np.ones((count, 3), kind))
    return stream.getvalue()


def npz_members(size: int, rng: random.Random) -> bytes:
    """A cloud beside arrays of its own length, and of another."""
    stream = io.BytesIO()
    rows = int(rng.uniform(0.1, 1) * _UNFOLDED / 12)
    more = {f"a{k}": np.zeros((rows + k % 2, 12), "i1") for k in range(8)}
    np.savez_compressed(stream, points=np.ones((rows, 3), "i1"), **more)
    return stream.getvalue()


def npz_overlapping(size: int, rng: random.Random) -> bytes:
    """Many entries of a directory that name the same bytes."""
    data = npy(np.zeros((1 << 18, 3), "<f4"))
    packed = zlib.compress(data)[2:-4]
    crc, name = zlib.crc32(data), b"points.npy"
    sizes = struct.pack("<III", crc, len(packed), len(data))
    local = b"PK\3\4" + struct.pack("<5H", 20, 0, 8, 0, 0) + sizes
    body = local + struct.pack("<HH", len(name), 0) + name + packed
    entries = b""
    count = rng.choice((20, 200))
    for k in range(count):
        entry = name if k == 0 else b"a%04d.npy" % k
        entries += b"PK\1\2" + struct.pack("<6H", 20, 20, 0, 8, 0, 0) + sizes
        entries += struct.pack("<5HII", len(entry), 0, 0, 0, 0, 0, 0) + entry
    end = b"PK\5\6" + struct.pack("<4HIIH", 0, 0, count, count, len(entries), len(body), 0)
    return body + entries + end


def laz(size: int, rng: random.Random, extra: int = 0) -> bytes:
    """Points evenly along a line, which take a hundredth of a byte each."""
    import laspy

    layout, version = rng.choice(((0, "1.2"), (6, "1.4")))
    header = laspy.LasHeader(point_format=layout, version=version)
    header.scales = [0.001] * 3
    for k in range(extra):
        header.add_extra_dim(laspy.ExtraBytesParams(f"e{k}", np.uint64))
    count = int(rng.uniform(0.3, 1.2) * _UNFOLDED / 24)
    record = laspy.ScaleAwarePointRecord.zeros(count, header=header)
    record["X"] = record["Y"] = np.arange(count, dtype=np.int32)
    stream = io.BytesIO()
    with laspy.open(stream, "w", header=header, do_compress=True, closefd=False) as writer:
        writer.write_points(record)
    return stream.getvalue()


def las(size: int, rng: random.Random) -> bytes:
    """Rows of 20 bytes, the shortest there are."""
    count = size // 20
    head = bytearray(227)
    head[:4], head[24:26] = b"LASF", b"\1\2"
    struct.pack_into("<HIIBHI", head, 94, 227, 227, 0, 0, 20, count)
    struct.pack_into("<6d", head, 131, *[0.001] * 3, *[0.0] * 3)
    return bytes(head) + bytes(20 * count)
