"""The elements of a PLY file: what the header says of them, and their rows in text."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64

from cfr_jax.io.budget import POINT, check_room
from cfr_jax.io.cloud import CloudFileError
from cfr_jax.io.formats.text import lines
from cfr_jax.io.formats.text.lines import Lines, Text
from cfr_jax.io.growing import Growing

# The types of the format, then those that programs write beside them.
TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
    "bool": "b1", "int64": "i8", "uint64": "u8", "long": "i8", "ulong": "u8", "float16": "f2",
    "half": "f2",
}  # fmt: skip
_POLYGONS = ("vertex_indices", "vertex_index")


@dataclass(frozen=True)
class Property:
    """A number of each row, or, if `counter` is the number type of its length, a list."""

    name: str
    kind: str
    counter: str | None = None

    @property
    def size(self) -> int:
        """Bytes of a number."""
        return int(self.kind[1])


@dataclass(frozen=True)
class Element:
    """An element of the header. Several properties may have one name."""

    name: str
    count: int
    properties: list[Property]

    @property
    def has_lists(self) -> bool:
        return any(prop.counter is not None for prop in self.properties)

    @property
    def polygons(self) -> int | None:
        """The list property that names the corners of faces, by its position."""
        return next(
            (
                position
                for position, prop in enumerate(self.properties)
                if prop.counter is not None and prop.name.lower() in _POLYGONS
            ),
            None,
        )


@dataclass(frozen=True, eq=False)
class Ragged:
    """A list property: all numbers one after the other, or a row for each list where these are
    equally long; and how many each one has."""

    values: np.ndarray
    sizes: np.ndarray


# What an element holds, a property each; None for what was not asked for.
Held = list["np.ndarray | Ragged | None"]


def wanted_of(element: Element, whole: bool) -> list[bool]:
    """The properties that are needed: of the vertices and faces, or all."""
    if whole:
        return [True] * len(element.properties)
    if element.name == "vertex":
        return [prop.counter is None for prop in element.properties]
    return [position == element.polygons for position in range(len(element.properties))]


def read_text(
    data: bytes, body: int, elements: list[Element], whole: bool
) -> tuple[list[Held], list[str]]:
    """All elements of a text file, which gives each row a line, and notes."""
    text = Text(data, body, data.count(b"\n", 0, body) + 1)
    held: list[Held] = []
    notes: list[str] = []
    for element in elements:
        if not element.properties:
            held.append([])
            continue
        rows = text.take(element.count, f"rows of element {element.name!r}")
        wanted = wanted_of(element, whole)
        if not any(wanted):
            held.append([None] * len(wanted))
            continue
        if element.has_lists:
            held.append(_ragged(rows, element, wanted))
            continue
        table = rows.table(each=POINT)
        if len(table) and table.shape[1] < len(element.properties):
            raise _too_few(rows.first, 0, element)
        if len(table) and table.shape[1] > len(element.properties):
            notes.append(
                f"rows of element {element.name!r} have {table.shape[1]} numbers for "
                f"{len(element.properties)} properties: left out the last ones"
            )
        columns = range(len(element.properties))
        held.append([table[:, k] if len(table) else np.empty(0) for k in columns])
    if whole:
        held = [_typed(columns, element) for columns, element in zip(held, elements, strict=True)]
    return held, notes


def _ragged(rows: Lines, element: Element, wanted: list[bool]) -> Held:
    """The wanted properties of an element with lists."""
    size = len(rows.data)
    found = [
        (Growing("f8" if prop.counter is None else prop.kind), Growing(prop.counter or "u1"))
        for prop in element.properties
    ]
    done = 0
    for block in rows.ragged():
        values, ends = block.values, np.cumsum(block.counts)
        position = ends - block.counts
        for prop, needed, (parts, sizes) in zip(element.properties, wanted, found, strict=True):
            _check_rows(position < ends, block, done, element)
            if prop.counter is None:
                if needed:
                    parts.append(values[position])
                position = position + 1
                continue
            lengths = values[position]
            position = position + 1
            # Also false for NaN, which no count may be.
            fits = (lengths >= 0) & (lengths <= ends - position) & (lengths % 1 == 0)
            _check_rows(fits, block, done, element)
            within = lengths.astype(np.int64)
            if needed:
                parts.append(gathered(values, position, within))
                sizes.append(lengths)
            position = position + within
        done += len(block.counts)
        check_room(sum(parts.nbytes + sizes.nbytes for parts, sizes in found), 1, size, "bytes")
    held: Held = []
    for prop, needed, (parts, sizes) in zip(element.properties, wanted, found, strict=True):
        if not needed:
            held.append(None)
        elif prop.counter is None:
            held.append(parts.joined())
        else:
            held.append(Ragged(parts.joined(), sizes.joined()))
    return held


def gathered(
    values: np.ndarray, starts: Int64[np.ndarray, " n"], sizes: Int64[np.ndarray, " n"]
) -> np.ndarray:
    """The stretches of `values` that begin at `starts` and are `sizes` long, joined."""
    firsts = np.cumsum(sizes) - sizes
    places = np.arange(int(sizes.sum())) + np.repeat(starts - firsts, sizes)
    return values[places]


def _typed(columns: Held, element: Element) -> Held:
    """The numbers of a text in the types that the header gives them, where these hold them."""
    typed: Held = []
    for values, prop in zip(columns, element.properties, strict=True):
        if isinstance(values, Ragged):
            typed.append(
                Ragged(_cast(values.values, prop.kind), _cast(values.sizes, prop.counter or "i4"))
            )
        else:
            typed.append(None if values is None else _cast(values, prop.kind))
    return typed


def _cast(values: np.ndarray, kind: str) -> np.ndarray:
    if values.dtype == np.dtype(kind):
        return values
    with np.errstate(all="ignore"):
        cast = values.astype(kind)
        if np.dtype(kind).kind == "f":
            return cast
        same = np.array_equal(cast.astype(np.float64), values)
    return cast if same else values


def _check_rows(good: np.ndarray, block: lines.Ragged, done: int, element: Element) -> None:
    """Raises CloudFileError for the first row of a block, behind `done` others, that is not."""
    if not good.all():
        row = int(np.argmin(good))
        raise _too_few(block.line(row), done + row, element)


def _too_few(line: int, row: int, element: Element) -> CloudFileError:
    names = ", ".join(prop.name for prop in element.properties)
    return CloudFileError(
        f"line {line}: row {row} of element {element.name!r} has fewer numbers than its "
        f"properties ({names:.80})"
    )
