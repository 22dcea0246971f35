"""AC3D, the models of the simulator FlightGear: polygons of objects within objects, in text."""

from __future__ import annotations

import re
from array import array
from typing import NoReturn

import numpy as np
from jaxtyping import Float64

from cfr_jax.geometry import motions
from cfr_jax.io.budget import POINT, check_surface
from cfr_jax.io.cloud import CloudFileError
from cfr_jax.io.formats.meshes.surfaces import append_polygons
from cfr_jax.io.formats.text.lines import Text
from cfr_jax.io.growing import Growing
from cfr_jax.io.mesh import Mesh

_KEY = re.compile(rb"^[ \t]*(OBJECT|rot|loc|data|numvert|numsurf|kids)(?!\S)([^\n]*)", re.MULTILINE)
_NO_MATERIAL = re.compile(rb"^[ \t\r]*(?!MATERIAL(?!\S))(\S{1,80})", re.MULTILINE)
_SURFACE = re.compile(
    rb"(?:[ \t]*SURF[ \t]+(\w{1,20})[ \t\r]*\n)?(?:[ \t]*mat[ \t]+\S+[ \t\r]*\n)?"
    rb"[ \t]*refs[ \t]+(\d{1,9})[ \t\r]*\n"
)
_CORNER = re.compile(rb"[ \t]*(\d{1,9})(?!\S)[^\n]*\n?")
_DEEPEST = 100  # levels of objects within objects
_LONGEST = 1000  # bytes of a line that says how an object lies, or how much it has
# Each of these takes time, however little it holds: as many are allowed in any file, ...
_KEYS, _SURFACES = 10_000, 100_000
# ... and one more for so many bytes. The shortest triangle has 30.
_BYTES_OF_A_KEY, _BYTES_OF_A_SURFACE = 500, 30
_AT_ONCE = 1 << 16  # corners
_MOST_CORNERS = 100_000  # of one surface: its triangles take much more than its corners


def parse_ac3d(data: bytes, name: str) -> Mesh:
    """Parses AC3D: all polygons of all objects, placed by the object tree.

    Lines are left out because they have no area. Raises CloudFileError, with the line, for a
    damaged file, and for one that becomes more than its size allows.
    """
    if not data.startswith(b"AC3D"):
        raise CloudFileError(f"starts with {_word(data[:8])}, wanted 'AC3D'")
    reader = _Reader(data)
    reader.read_object(np.eye(4))
    return Mesh(reader.points.joined(), reader.triangles.joined(), name)


class _Reader:
    """The bytes of an AC3D file, read once from top to bottom."""

    def __init__(self, data: bytes):
        self._data, self._keys, self._surfaces = data, 0, 0
        self._at = self._behind_line(0)
        self._counted = 0, 1  # a place, and the number of its line
        self.points, self.triangles = Growing("f8", 3), Growing("i8", 3)

    def read_object(self, parent: Float64[np.ndarray, "4 4"], depth: int = 0) -> bool:
        """Reads the next OBJECT and its children. MATERIAL lines before it are skipped.

        Returns whether there was one: some exporters drop an object without reducing the number of
        children, and the file then ends early.
        """
        if depth > _DEEPEST:
            self._fail(f"wanted objects within at most {_DEEPEST} others")
        begin = _NO_MATERIAL.search(self._data, self._at)
        self._at = len(self._data) if begin is None else begin.start(1)
        if begin is None:
            return False
        if begin[1] != b"OBJECT":
            self._fail(f"wanted OBJECT or MATERIAL, got {_word(begin[1])}")
        self._at = self._behind_line(self._at)
        local = np.eye(4)
        first = count = 0
        while True:
            key, words = self._next_key()
            match key, len(words):
                case b"rot", 9:
                    # A row in the file is the image of an axis of the object.
                    local[:3, :3] = self._floats(words).reshape(3, 3).T
                case b"loc", 3:
                    local[:3, 3] = self._floats(words)
                case b"data", 1:
                    self._skip_text(self._count(words))
                case b"numvert", 1:
                    first, count = len(self.points), self._count(words)
                    self._read_vertices(count, parent @ local)
                case b"numsurf", 1:
                    self._read_surfaces(self._count(words), first, count)
                case b"kids", 1:
                    for _ in range(self._count(words)):
                        if not self.read_object(parent @ local, depth + 1):
                            break
                    return True
                case b"OBJECT", _:
                    self._fail("wanted 'kids' before the next OBJECT", lines_back=1)
                case _:  # not as it should be, and so without effect
                    pass

    def _read_vertices(self, count: int, motion: Float64[np.ndarray, "4 4"]) -> None:
        """The first three numbers of each line; others are places in a texture."""
        behind = _KEY.search(self._data, self._at)
        end = None if behind is None else behind.start()
        lines = Text(self._data, self._at, self._line(), end=end).take(count, "vertices")
        check_surface(
            len(self.points) + count, len(self.triangles), len(self._data), taken=POINT * count
        )
        for rows in lines.ragged() if count else ():
            if len(rows.counts) and rows.counts.min() < 3:
                where = rows.line(int(np.argmin(rows.counts)))
                raise CloudFileError(f"line {where}: wanted 3 numbers, got {rows.counts.min()}")
            starts = np.cumsum(rows.counts) - rows.counts
            with np.errstate(invalid="ignore", over="ignore"):  # damaged numbers are removed later
                self.points.append(
                    motions.apply(motion, rows.values[starts[:, None] + np.arange(3)])
                )
        self._at = lines.end

    def _read_surfaces(self, number: int, first: int, count: int) -> None:
        """That many surfaces, whose corners are `count` vertices from the `first` on."""
        corners, sizes = array("q"), array("q")
        for _ in range(number):
            head = _SURFACE.match(self._data, self._at)
            if head is None:
                self._fail("wanted SURF, mat and refs with the number of corners")
            is_polygon = self._kind(head[1]) == 0
            self._at = head.end()
            self._surfaces += 1
            if self._surfaces > _SURFACES + len(self._data) // _BYTES_OF_A_SURFACE:
                self._fail(f"more than {self._surfaces - 1} surfaces of a few bytes each")
            here, size = len(corners), int(head[2])
            if size > _MOST_CORNERS:
                self._fail(f"a surface has {size} corners, wanted at most {_MOST_CORNERS}")
            for _ in range(size):
                corner = _CORNER.match(self._data, self._at)
                if corner is None:
                    self._fail("wanted the index of a corner")
                corners.append(int(corner[1]))
                if corners[-1] >= count:
                    self._fail(f"a surface names vertex {corners[-1]} of {count}")
                self._at = corner.end()
            if is_polygon:
                sizes.append(size)
            else:
                del corners[here:]
            if len(corners) >= _AT_ONCE:
                self._append(corners, sizes, first)
        self._append(corners, sizes, first)

    def _append(self, corners: array[int], sizes: array[int], first: int) -> None:
        """Adds the polygons, and forgets them."""
        named, each = (np.array(values, np.int64) for values in (corners, sizes))
        append_polygons(self.triangles, named + first, each, len(self.points), len(self._data))
        del corners[:], sizes[:]

    def _kind(self, flags: bytes | None) -> int:
        """What a surface is: 0 is a polygon, and others are lines."""
        try:
            return 0 if flags is None else int(flags, 0) & 0xF
        except ValueError:
            self._fail(f"wanted the flags of a surface, got {_word(flags)}")

    def _skip_text(self, length: int) -> None:
        """Skips free text of `length` characters, which may contain line ends, each of them one."""
        end = self._at + length
        while (behind := self._at + length + self._data.count(b"\r\n", self._at, end)) > end:
            end = behind
        self._at = self._behind_line(end)

    def _next_key(self) -> tuple[bytes, list[bytes]]:
        """The first word of the next line that says how an object lies or how much it has, and the
        other words."""
        found = _KEY.search(self._data, self._at)
        if found is None:
            self._at = len(self._data)
            self._fail("ends too early")
        self._at = self._behind_line(found.end())
        self._keys += 1
        if self._keys > _KEYS + len(self._data) // _BYTES_OF_A_KEY:
            self._fail(f"more than {self._keys - 1} lines of objects that hold little")
        if len(found[2]) > _LONGEST:
            self._fail(f"is longer than {_LONGEST} bytes, the most we read", lines_back=1)
        return found[1], found[2].split()

    def _behind_line(self, at: int) -> int:
        newline = self._data.find(b"\n", at)
        return len(self._data) if newline < 0 else newline + 1

    def _floats(self, words: list[bytes]) -> Float64[np.ndarray, " n"]:
        try:
            return np.array([float(word) for word in words])
        except ValueError:
            told = _word(b" ".join(words))
            self._fail(f"wanted {len(words)} numbers, got {told}", lines_back=1)

    def _count(self, words: list[bytes]) -> int:
        if not words[0].isdigit() or len(words[0]) > 9:
            self._fail(f"wanted a count, got {_word(words[0])}", lines_back=1)
        return int(words[0])

    def _line(self) -> int:
        at, line = self._counted
        self._counted = self._at, line + self._data.count(b"\n", at, self._at)
        return self._counted[1]

    def _fail(self, message: str, lines_back: int = 0) -> NoReturn:
        raise CloudFileError(f"line {self._line() - lines_back}: {message}")


def _word(word: bytes | None) -> str:
    return repr((word or b"")[:80].decode("latin1"))
